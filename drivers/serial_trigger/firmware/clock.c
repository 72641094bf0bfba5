/* See clock.h. */
#include "clock.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <util/atomic.h>

static volatile uint32_t laps; /* of the timer: 32.768 ms each */

ISR(TIMER1_OVF_vect)
{
    laps++;
}

void clock_start(void)
{
    TCCR1B = _BV(ICNC1) | _BV(ICES1) | _BV(CS11);
    TIMSK1 |= _BV(TOIE1);
}

uint32_t clock_at(uint16_t count)
{
    uint32_t lap = laps;

    if ((TIFR1 & _BV(TOV1)) && count < 0x8000) /* it has wrapped, and the interrupt waits for us */
        lap++;
    return lap << 16 | count;
}

uint32_t clock_now(void)
{
    return clock_at(TCNT1);
}

uint32_t clock_us(uint32_t ticks)
{
    uint32_t lap;

    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        lap = laps;
    }
    lap += (int16_t)((uint16_t)(ticks >> 16) - (uint16_t)lap);
    return lap << 15 | (uint16_t)ticks >> 1;
}
