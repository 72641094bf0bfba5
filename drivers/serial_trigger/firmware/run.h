/* The table and its run: edges in, pulses out, by timer 1. Knows no line and no command. */
#ifndef RUN_H
#define RUN_H

#include <stdbool.h>
#include <stdint.h>

#include "board.h"

enum source { SOURCE_INT, SOURCE_VSYNC, SOURCE_EXT };
enum run_state { RUN_IDLE, RUN_ARMED, RUN_RUNNING };
enum fault { FAULT_NONE, FAULT_NOEDGE, FAULT_OVERRUN };

struct event {
    uint32_t ticks; /* when the outputs rose */
    uint16_t pass;
    uint8_t step;
};

struct fault_report {
    uint32_t ticks;
    uint16_t pass;
    uint8_t step;
    uint8_t fault; /* enum fault */
};

void run_start(void); /* outputs low, table empty: the state after power-on */

/* The table; only while idle. Times in microseconds, checked by the caller. */
void run_clear(void);
bool run_add(uint32_t dark_us, uint32_t exposure_us, uint8_t outputs, uint8_t edges); /* false: it is full */
uint8_t run_length(void);
void run_repeat(uint16_t passes); /* 0: until stopped */
void run_source(enum source source, bool falling);
void run_timeout(uint16_t ms); /* 0: an edge may take its time */

void run_arm(void);
bool run_fire(void); /* false: not armed, or not its source */
void run_stop(void); /* outputs low; also from an interrupt */
void run_poll(void); /* from the main loop: the time-out */

enum run_state run_state(void);
uint32_t run_pulses(void); /* with outputs, since run_arm */
enum fault run_last_fault(void);

/* Whether there is a pulse or fault since run_heard. */
bool run_news(void);
void run_heard(void);

/* Pulses by number since run_arm, of the last EVENTS_MAX. */
bool run_event(uint32_t number, struct event *event);

/* The fault to report, once. */
bool run_take_fault(struct fault_report *report);

#endif
