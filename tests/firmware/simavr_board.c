/* The trigger board in simavr: runs the firmware's ELF file, feeds its UART and inputs, and logs its pins by cycle.
 *
 *     simavr_board ELF script        reads actions from stdin, runs them in simulated time, logs to stdout
 *     simavr_board ELF pty [VSYNC_US]  the UART on a pty in real time, edges on VSYNC every VSYNC_US until a line comes
 *                                    on stdin; ends with stdin
 *
 * Actions of a script, in order of cycles:   CYCLE byte HEX  |  CYCLE VSYNC 0|1  |  CYCLE EXT 0|1  |  CYCLE end
 * Log of a script:   CYCLE PIN 0|1  |  CYCLE line TEXT  |  CYCLE lap  (when a lap of timer 1 began, at the end)
 * With a pty its path is all:   pty PATH
 *
 * simavr 1.6 models the compare outputs loosely: it sets them at overflow in every mode, knows no match by command
 * (FOC1x), and any write to the port changes them. So they are modelled here, from the timer's own matches, as the
 * data sheet has them (ATmega328P, "Compare Match Output Unit" of the 16-bit timer).
 */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <simavr/avr_extint.h>
#include <simavr/avr_ioport.h>
#include <simavr/avr_timer.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#define FREQUENCY 16000000UL
#define BYTE_CYCLES 1496 /* a byte on simavr's line: 11 bits of 17 x 8 cycles */
#define PACE_CYCLES 4000 /* real time is kept in steps of this */

enum { REG_PORTB = 0x25, REG_DDRB = 0x24, REG_TCCR1A = 0x80, REG_TCCR1C = 0x82 };

static avr_t *avr;
static avr_timer_t *timer;
static bool scripted;

static void log_pin(avr_cycle_count_t cycle, const char *pin, int level)
{
    if (scripted) /* nobody reads along with a board that runs in real time */
        printf("%llu %s %d\n", (unsigned long long)cycle, pin, level);
}

/* --- the compare outputs ------------------------------------------------------------------------------------------ */

static struct {
    const char *name;
    int bit, com_shift, foc_bit;
    bool latch, level;
} compare[2] = {{"CAM1", 1, 6, 7, false, false}, {"CAM2", 2, 4, 6, false, false}};

static int com_of(int i)
{
    return avr->data[REG_TCCR1A] >> compare[i].com_shift & 3;
}

static void update_compare(avr_cycle_count_t cycle)
{
    for (int i = 0; i < 2; i++) {
        bool port = avr->data[REG_PORTB] >> compare[i].bit & 1;
        bool level = (com_of(i) ? compare[i].latch : port) && (avr->data[REG_DDRB] >> compare[i].bit & 1);

        if (level != compare[i].level)
            log_pin(cycle, compare[i].name, level);
        compare[i].level = level;
    }
}

static void act(int i, avr_cycle_count_t cycle)
{
    if (com_of(i) >= 2)
        compare[i].latch = com_of(i) == 3;
    update_compare(cycle);
}

/* simavr raises this at a match with the mode's own level, and at overflow with the other one: that one is not real. */
static void on_match(struct avr_irq_t *irq, uint32_t value, void *param)
{
    int i = (int)(intptr_t)param;

    (void)irq;
    if (com_of(i) >= 2 && (com_of(i) == 3) == (value & 1))
        act(i, timer->tov_base + timer->comp[i].comp_cycles);
}

static void on_register(avr_t *avr_, avr_io_addr_t addr, uint8_t value, void *param)
{
    (void)param;
    if (addr == REG_TCCR1C) {
        for (int i = 0; i < 2; i++)
            if (value >> compare[i].foc_bit & 1)
                act(i, avr_->cycle);
        return;
    }
    avr_->data[addr] = value;
    update_compare(avr_->cycle);
}

static void on_output(struct avr_irq_t *irq, uint32_t value, void *param)
{
    if (irq->value != value)
        log_pin(avr->cycle, param, value & 1);
}

/* --- inputs and the line ------------------------------------------------------------------------------------------ */

static void drive(char port, int bit, int level)
{
    avr_ioport_external_t external = {.name = port, .mask = 1u << bit, .value = (unsigned)level << bit};

    avr_ioctl(avr, AVR_IOCTL_IOPORT_SET_EXTERNAL(port), &external);
    avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ(port), bit), level);
}

static void drive_input(const char *name, int level)
{
    bool vsync = strcmp(name, "VSYNC") == 0;

    drive(vsync ? 'B' : 'D', vsync ? 0 : 2, level);
    log_pin(avr->cycle, name, level);
}

static void feed(uint8_t byte)
{
    avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT), byte);
}

static void on_byte_to_log(struct avr_irq_t *irq, uint32_t value, void *param)
{
    static char line[256];
    static size_t length;

    (void)irq, (void)param;
    if (value == '\n' || length == sizeof line - 1) {
        line[length] = 0;
        printf("%llu line %s\n", (unsigned long long)avr->cycle, line);
        length = 0;
    } else {
        line[length++] = value;
    }
}

/* --- a script in simulated time ----------------------------------------------------------------------------------- */

static struct {
    avr_cycle_count_t cycle;
    char what[8];
    unsigned value;
} action;

static bool over;

static bool next_action(void)
{
    unsigned long long cycle;
    char text[64];

    if (!fgets(text, sizeof text, stdin) || sscanf(text, "%llu %7s %x", &cycle, action.what, &action.value) < 2)
        return false;
    action.cycle = cycle;
    return true;
}

static avr_cycle_count_t on_script(avr_t *avr_, avr_cycle_count_t when, void *param)
{
    (void)when, (void)param;
    while (action.cycle <= avr_->cycle) {
        if (strcmp(action.what, "byte") == 0)
            feed(action.value);
        else if (strcmp(action.what, "end") != 0)
            drive_input(action.what, action.value);
        else
            over = true;
        if (over || !next_action()) {
            over = true;
            return 0;
        }
    }
    return action.cycle;
}

static void no_sleep(avr_t *avr_, avr_cycle_count_t cycles)
{
    (void)avr_, (void)cycles;
}

/* --- a pty in real time ------------------------------------------------------------------------------------------- */

static int pty = -1;
static uint8_t waiting[4096];
static size_t first, last;
static struct timespec started;
static long vsync_cycles;

static void on_byte_to_pty(struct avr_irq_t *irq, uint32_t value, void *param)
{
    uint8_t byte = value;

    (void)irq, (void)param;
    if (write(pty, &byte, 1) < 0 && errno != EAGAIN && errno != EIO)
        over = true;
}

static avr_cycle_count_t on_feed(avr_t *avr_, avr_cycle_count_t when, void *param)
{
    (void)avr_, (void)param;
    if (first < last)
        feed(waiting[first++]);
    return when + BYTE_CYCLES;
}

static avr_cycle_count_t on_vsync(avr_t *avr_, avr_cycle_count_t when, void *param)
{
    static int level;

    (void)avr_, (void)param;
    if (!vsync_cycles && !level)
        return 0;
    level = !level;
    drive_input("VSYNC", level);
    return !vsync_cycles || level ? when + 1600 : when + vsync_cycles - 1600;
}

/* Wait until real time has come as far, then take what the host wrote. Behind it, do not wait: catch up. */
static avr_cycle_count_t on_pace(avr_t *avr_, avr_cycle_count_t when, void *param)
{
    struct timespec until = started;
    struct pollfd in = {.fd = 0, .events = POLLIN};
    unsigned long long ns = avr_->cycle * 125 / 2;

    (void)param;
    until.tv_sec += (until.tv_nsec + ns) / 1000000000;
    until.tv_nsec = (until.tv_nsec + ns) % 1000000000;
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, NULL);
    if (first == last)
        first = last = 0;
    if (last < sizeof waiting) {
        ssize_t got = read(pty, waiting + last, sizeof waiting - last);

        if (got > 0)
            last += got;
    }
    if (poll(&in, 1, 0) > 0) {
        char line[64];

        if (read(0, line, sizeof line) <= 0)
            over = true; /* the one who started us has closed our stdin */
        vsync_cycles = 0;
    }
    return when + PACE_CYCLES;
}

static void open_pty(void)
{
    struct termios raw;
    int slave;

    pty = posix_openpt(O_RDWR | O_NOCTTY | O_NONBLOCK);
    if (pty < 0 || grantpt(pty) || unlockpt(pty) || (slave = open(ptsname(pty), O_RDWR | O_NOCTTY)) < 0) {
        perror("pty");
        exit(1);
    }
    tcgetattr(slave, &raw); /* the slave stays open: without a reader the pty would hang up */
    cfmakeraw(&raw);
    tcsetattr(slave, TCSANOW, &raw);
    printf("pty %s\n", ptsname(pty));
    fflush(stdout);
    clock_gettime(CLOCK_MONOTONIC, &started);
}

/* ------------------------------------------------------------------------------------------------------------------ */

static void make_board(const char *path)
{
    elf_firmware_t firmware = {0};
    uint32_t flags = 0;

    avr_global_logger_set(NULL);
    if (elf_read_firmware(path, &firmware)) {
        fprintf(stderr, "%s cannot be read\n", path);
        exit(1);
    }
    avr = avr_make_mcu_by_name("atmega328p");
    avr_init(avr);
    avr->log = LOG_ERROR;
    avr_load_firmware(avr, &firmware);
    avr->frequency = FREQUENCY;
    avr->sleep = no_sleep;
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    for (avr_io_t *io = avr->io_port; io; io = io->next)
        if (strcmp(io->kind, "timer") == 0 && ((avr_timer_t *)io)->name == '1')
            timer = (avr_timer_t *)io;
    for (int i = 0; i < 2; i++) {
        avr_irq_t *match = timer->io.irq + TIMER_IRQ_OUT_COMP + i;

        avr_unconnect_irq(match, avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('B'), compare[i].bit));
        avr_irq_register_notify(match, on_match, (void *)(intptr_t)i);
    }
    avr_register_io_write(avr, REG_TCCR1A, on_register, NULL);
    avr_register_io_write(avr, REG_TCCR1C, on_register, NULL);
    avr_register_io_write(avr, REG_PORTB, on_register, NULL);
    avr_register_io_write(avr, REG_DDRB, on_register, NULL);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('D'), 4), on_output, "SYNC");
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('B'), 5), on_output, "LED");
    avr_extint_set_strict_lvl_trig(avr, 0, 0); /* or a low EXT is looked at every cycle, and the chip never sleeps */
    drive('B', 0, 0);
    drive('D', 2, 0);
}

int main(int argc, char **argv)
{
    avr_irq_t *output;

    scripted = argc == 3 && strcmp(argv[2], "script") == 0;
    if (!scripted && (argc < 3 || strcmp(argv[2], "pty") != 0)) {
        fprintf(stderr, "usage: simavr_board ELF script | simavr_board ELF pty [VSYNC_US]\n");
        return 2;
    }
    make_board(argv[1]);
    output = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT);
    if (scripted) {
        avr_irq_register_notify(output, on_byte_to_log, NULL);
        if (!next_action())
            return 2;
        avr_cycle_timer_register(avr, action.cycle, on_script, NULL);
    } else {
        open_pty();
        avr_irq_register_notify(output, on_byte_to_pty, NULL);
        avr_cycle_timer_register(avr, PACE_CYCLES, on_pace, NULL);
        avr_cycle_timer_register(avr, BYTE_CYCLES, on_feed, NULL);
        vsync_cycles = argc > 3 ? atol(argv[3]) * 16 : 0;
        if (vsync_cycles > 3200)
            avr_cycle_timer_register(avr, vsync_cycles, on_vsync, NULL);
    }
    while (!over) {
        int state = avr_run(avr);

        if (state == cpu_Done || state == cpu_Crashed) {
            fprintf(stderr, "the firmware stopped at cycle %llu\n", (unsigned long long)avr->cycle);
            return 1;
        }
    }
    printf("%llu lap\n", (unsigned long long)timer->tov_base);
    return 0;
}
