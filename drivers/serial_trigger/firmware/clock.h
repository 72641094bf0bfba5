/* The board's time: timer 1 at 2 MHz, its 16 bits carried on in software. Ticks are 32 bit and wrap after 35.8 min;
 * microseconds are 32 bit and wrap after 71.6 min. */
#ifndef CLOCK_H
#define CLOCK_H

#include <stdint.h>

void clock_start(void);

/* Call these with interrupts off. */
uint32_t clock_now(void);
uint32_t clock_at(uint16_t count); /* of a count that the timer had less than 16 ms ago */

/* Microseconds of ticks that are less than 17 minutes away. */
uint32_t clock_us(uint32_t ticks);

#endif
