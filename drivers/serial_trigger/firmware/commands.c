/* See commands.h. The protocol is docs/reference/trigger-protocol.md. */
#include "commands.h"

#include <avr/pgmspace.h>
#include <string.h>

#include "board.h"
#include "clock.h"
#include "line.h"
#include "run.h"
#include "serial.h"

enum error { ERR_CRC = 1, ERR_SYNTAX, ERR_RANGE, ERR_STATE, ERR_FULL, ERR_LINE, ERR_UNKNOWN };

static bool crc;           /* every line carries its sum, in both directions */
static uint32_t reported;  /* events said since ARM */
static uint16_t lost;      /* events that could not be said in time */

/* --- answers ------------------------------------------------------------------------------------------------------ */

static void open_ok(void)
{
    line_open();
    line_text_P(PSTR("OK"));
}

static void say_ok(void)
{
    open_ok();
    line_close(crc);
}

static void say_error(enum error error)
{
    static const char crc_[] PROGMEM = "ERR 1,crc", syntax[] PROGMEM = "ERR 2,syntax",
                      range[] PROGMEM = "ERR 3,range", state[] PROGMEM = "ERR 4,state",
                      full[] PROGMEM = "ERR 5,full", line[] PROGMEM = "ERR 6,line",
                      unknown[] PROGMEM = "ERR 7,unknown";
    static const char *const texts[] PROGMEM = {crc_, syntax, range, state, full, line, unknown};

    line_open();
    line_text_P((const char *)pgm_read_word(&texts[error - 1]));
    line_close(crc);
}

/* --- commands: `at` stands behind the command's name -------------------------------------------------------------- */

static bool idle_or_error(void)
{
    if (run_state() == RUN_IDLE)
        return true;
    say_error(ERR_STATE);
    return false;
}

/* The one number of a command, alone on the rest of the line. */
static bool number_or_error(const char *at, uint32_t limit, uint32_t *number)
{
    bool too_large = false;

    if (*at++ != ' ' || !line_take(&at, limit, number, &too_large) || *at) {
        say_error(ERR_SYNTAX);
        return false;
    }
    if (too_large)
        say_error(ERR_RANGE);
    return !too_large;
}

static void do_identify(const char *at)
{
    (void)at;
    open_ok();
    line_text_P(PSTR(" fringed,trigger-atmega328p," PROTOCOL "," FIRMWARE));
    line_close(crc);
}

static void do_reset(const char *at)
{
    (void)at;
    run_stop();
    run_clear();
    run_repeat(1);
    run_source(SOURCE_INT, false);
    say_ok();
}

static void do_crc(const char *at)
{
    uint32_t on;

    if (number_or_error(at, 1, &on)) {
        crc = on;
        say_ok();
    }
}

static void do_state(const char *at)
{
    enum run_state state = run_state();
    enum fault fault = run_last_fault();

    (void)at;
    open_ok();
    line_text_P(state == RUN_IDLE ? PSTR(" IDLE") : state == RUN_ARMED ? PSTR(" ARMED") : PSTR(" RUNNING"));
    line_number(run_pulses());
    line_text_P(fault == FAULT_NONE ? PSTR(" NONE") : fault == FAULT_NOEDGE ? PSTR(" NOEDGE") : PSTR(" OVERRUN"));
    line_close(crc);
}

static void do_clear(const char *at)
{
    (void)at;
    if (idle_or_error()) {
        run_clear();
        say_ok();
    }
}

static void do_add(const char *at)
{
    uint32_t dark, exposure, outputs, edges = 1;
    bool too_large = false;
    bool whole = *at++ == ' ' && line_take(&at, TIME_MAX_US, &dark, &too_large) && *at++ == ',' &&
                 line_take(&at, TIME_MAX_US, &exposure, &too_large) && *at++ == ',' &&
                 line_take(&at, OUT_ALL, &outputs, &too_large);

    if (whole && *at == ',')
        whole = (at++, line_take(&at, 255, &edges, &too_large));
    if (!whole || *at) {
        say_error(ERR_SYNTAX);
    } else if (too_large || dark < DARK_MIN_US || exposure < EXPOSURE_MIN_US) {
        say_error(ERR_RANGE);
    } else if (idle_or_error()) {
        if (run_add(dark, exposure, outputs, edges)) {
            open_ok();
            line_number(run_length() - 1);
            line_close(crc);
        } else {
            say_error(ERR_FULL);
        }
    }
}

static void do_length(const char *at)
{
    (void)at;
    open_ok();
    line_number(run_length());
    line_close(crc);
}

static void do_repeat(const char *at)
{
    uint32_t passes;

    if (number_or_error(at, 65535, &passes) && idle_or_error()) {
        run_repeat(passes);
        say_ok();
    }
}

static void do_timeout(const char *at)
{
    uint32_t ms;

    if (number_or_error(at, TIMEOUT_MAX_MS, &ms) && idle_or_error()) {
        run_timeout(ms);
        say_ok();
    }
}

static void do_source(const char *at)
{
    static const char names[][7] PROGMEM = {" INT", " VSYNC", " EXT"};
    bool falling = false;

    for (uint8_t i = 0; i < 3; i++) {
        uint8_t length = strlen_P(names[i]);

        if (strncmp_P(at, names[i], length) != 0)
            continue;
        at += length;
        if (strcmp_P(at, PSTR(",FALL")) == 0)
            falling = true;
        else if (*at && strcmp_P(at, PSTR(",RISE")) != 0)
            break;
        if (idle_or_error()) {
            run_source(i, falling);
            say_ok();
        }
        return;
    }
    say_error(ERR_SYNTAX);
}

static void do_arm(const char *at)
{
    (void)at;
    if (run_length() == 0) {
        say_error(ERR_STATE);
    } else if (idle_or_error()) {
        reported = 0;
        lost = 0;
        run_arm();
        say_ok();
    }
}

static void do_fire(const char *at)
{
    (void)at;
    if (run_fire())
        say_ok();
    else
        say_error(ERR_STATE);
}

static void do_abort(const char *at)
{
    (void)at;
    run_stop();
    say_ok();
}

static void do_time(const char *at)
{
    (void)at;
    open_ok();
    line_number(clock_us(serial_line_ticks()));
    line_close(crc);
}

static void say_event(const struct event *event)
{
    line_number(event->pass);
    line_number(event->step);
    line_number(clock_us(event->ticks));
    line_close(crc);
}

static void do_event(const char *at)
{
    uint32_t number;
    struct event event;

    if (!number_or_error(at, UINT32_MAX, &number))
        return;
    if (run_event(number, &event)) {
        open_ok();
        say_event(&event);
    } else {
        say_error(ERR_RANGE);
    }
}

struct command {
    char name[13];
    bool plain; /* nothing may follow its name */
    void (*act)(const char *at);
};

static const struct command commands[] PROGMEM = {
    {"TIME?", true, do_time},         {"STAT?", true, do_state},       {"ABORT", true, do_abort},
    {"FIRE", true, do_fire},          {"ARM", true, do_arm},           {"EVT?", false, do_event},
    {"SEQ:ADD", false, do_add},       {"SEQ:CLEAR", true, do_clear},   {"SEQ:LEN?", true, do_length},
    {"SEQ:SOURCE", false, do_source}, {"SEQ:REPEAT", false, do_repeat}, {"SEQ:TIMEOUT", false, do_timeout},
    {"*IDN?", true, do_identify},     {"*RST", true, do_reset},        {"*CRC", false, do_crc},
};

static void obey(const char *line)
{
    for (uint8_t i = 0; i < sizeof commands / sizeof *commands; i++) {
        struct command command;
        uint8_t length;

        memcpy_P(&command, &commands[i], sizeof command);
        length = strlen(command.name);
        if (strncmp(line, command.name, length) != 0 || (line[length] && line[length] != ' '))
            continue;
        if (command.plain && line[length])
            say_error(ERR_SYNTAX);
        else
            command.act(line + length);
        return;
    }
    say_error(ERR_UNKNOWN);
}

/* --- lines -------------------------------------------------------------------------------------------------------- */

void commands_ready(void)
{
    line_open();
    line_text_P(PSTR("!EVT READY"));
    line_close(crc);
}

void commands_read(void)
{
    static char line[LINE_MAX];
    static uint8_t length;
    static bool broken;
    int16_t byte;

    while ((byte = serial_read()) >= 0) {
        if (byte == SERIAL_ABORT) {
            length = 0;
            broken = false;
        } else if (byte == SERIAL_BROKEN) {
            broken = true;
        } else if (byte == '\n') {
            uint8_t taken = length;

            if (taken && line[taken - 1] == '\r')
                taken--;
            line[taken] = 0;
            length = 0;
            if (broken) {
                broken = false;
                say_error(ERR_LINE);
            } else if (taken) {
                enum crc_check check = line_check(line, taken);

                if (check == CRC_WRONG || (crc && check == CRC_NONE))
                    say_error(ERR_CRC);
                else
                    obey(line);
            }
            return; /* one line at a time: reports come between */
        } else if (length == LINE_MAX - 1) {
            broken = true;
        } else {
            line[length++] = byte;
        }
    }
}

bool commands_report(void)
{
    struct fault_report fault;
    struct event event;
    uint32_t pulses;

    if (serial_room() < LINE_MAX)
        return false;
    run_heard();
    pulses = run_pulses();
    if (pulses - reported > EVENTS_MAX) {
        lost += pulses - reported - EVENTS_MAX;
        reported = pulses - EVENTS_MAX;
    }
    if (reported < pulses) {
        if (run_event(reported, &event)) {
            reported++;
            line_open();
            line_text_P(PSTR("!EVT"));
            say_event(&event);
        }
        return true; /* else it was overwritten meanwhile, and is counted the next time */
    }
    if (lost) {
        line_open();
        line_text_P(PSTR("!FAULT LOST"));
        line_number(lost);
        line_close(crc);
        lost = 0;
        return true;
    }
    if (run_take_fault(&fault)) {
        line_open();
        line_text_P(fault.fault == FAULT_NOEDGE ? PSTR("!FAULT NOEDGE") : PSTR("!FAULT OVERRUN"));
        line_number(fault.pass);
        line_number(fault.step);
        line_number(clock_us(fault.ticks));
        line_close(crc);
        return true;
    }
    return false;
}
