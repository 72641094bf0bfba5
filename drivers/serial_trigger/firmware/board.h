/* The board: an ATmega328P at 16 MHz (Arduino Uno, Nano). Pins, limits and the version; nothing here does anything. */
#ifndef BOARD_H
#define BOARD_H

#include <avr/io.h>
#include <stdint.h>

#define PROTOCOL "1.0"
#define FIRMWARE "1.0.0"

/* Inputs. VSYNC must be ICP1, whose edges the timer itself stamps. */
#define VSYNC_BIT PB0 /* Arduino D8 */
#define EXT_BIT PD2   /* Arduino D2, INT0 */

/* Outputs, by their bit in a step's mask. The cameras' are the timer's own compare outputs. */
enum { OUT_CAM1 = 1, OUT_CAM2 = 2, OUT_SYNC = 4, OUT_LED = 8, OUT_ALL = 15 };
#define CAM1_BIT PB1 /* Arduino D9, OC1A */
#define CAM2_BIT PB2 /* Arduino D10, OC1B */
#define SYNC_BIT PD4 /* Arduino D4 */
#define LED_BIT PB5  /* Arduino D13, the board's own LED */

#define STEPS_MAX 64
#define EVENTS_MAX 32 /* a power of two */
#define LINE_MAX 64   /* bytes of a line with its LF */

#define DARK_MIN_US 50
#define EXPOSURE_MIN_US 50
#define TIME_MAX_US 10000000UL
#define TIMEOUT_MAX_MS 60000UL
#define VSYNC_TIMEOUT_MS 200

#define TICKS_PER_US 2 /* timer 1 at F_CPU / 8 */
#define TICKS_PER_MS 2000UL

#endif
