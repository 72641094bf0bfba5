/* The UART: 115200 baud, 8N1, a ring of bytes each way. */
#ifndef SERIAL_H
#define SERIAL_H

#include <stdbool.h>
#include <stdint.h>

#define SERIAL_ABORT 0x18 /* CAN: acts in the interrupt, at any time */
#define SERIAL_BROKEN 0x100 /* in place of bytes that were lost or damaged on the way */

void serial_start(void);
bool serial_idle(void); /* nothing to read; call with interrupts off */
int16_t serial_read(void); /* -1: nothing, SERIAL_BROKEN, or a byte */
uint32_t serial_line_ticks(void); /* when the last LF had arrived */
uint8_t serial_room(void);
void serial_write(const char *text); /* waits for room */

#endif
