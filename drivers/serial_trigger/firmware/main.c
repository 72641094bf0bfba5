/* The trigger board's firmware: starts the parts, then reads, reports and sleeps. Time is kept by interrupts alone. */
#include <avr/interrupt.h>
#include <avr/sleep.h>

#include "board.h"
#include "clock.h"
#include "commands.h"
#include "run.h"
#include "serial.h"

int main(void)
{
    run_start();
    clock_start();
    serial_start();
    set_sleep_mode(SLEEP_MODE_IDLE);
    sei();
    commands_ready();
    for (;;) {
        commands_read();
        run_poll();
        if (commands_report())
            continue;
        cli();
        if (serial_idle() && (!run_news() || serial_room() < LINE_MAX)) { /* room comes with an interrupt, too */
            sleep_enable();
            sei(); /* takes effect after the next instruction: nothing can slip in between */
            sleep_cpu();
            sleep_disable();
        }
        sei();
    }
}
