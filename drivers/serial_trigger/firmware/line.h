/* Lines of the protocol: put together with their check sum, taken apart into numbers. */
#ifndef LINE_H
#define LINE_H

#include <stdbool.h>
#include <stdint.h>

uint8_t crc8(const char *text, uint8_t length); /* polynomial 0x07, initial 0 */

/* Write a line, with a check sum where `crc`. One at a time: open, parts, close. */
void line_open(void);
void line_text_P(const char *text); /* in program memory */
void line_number(uint32_t number);  /* with a blank before it */
void line_close(bool crc);

/* Take the check sum off a line. */
enum crc_check { CRC_NONE, CRC_RIGHT, CRC_WRONG };
enum crc_check line_check(char *line, uint8_t length);

/* Read a decimal number at *at and move behind it; false: there is none, or above `limit`. */
bool line_take(const char **at, uint32_t limit, uint32_t *number, bool *too_large);

#endif
