/* See line.h. */
#include "line.h"

#include <avr/pgmspace.h>
#include <string.h>

#include "board.h"
#include "serial.h"

static char out[LINE_MAX + 1];
static uint8_t filled;

uint8_t crc8(const char *text, uint8_t length)
{
    uint8_t crc = 0;

    while (length--) {
        crc ^= (uint8_t)*text++;
        for (uint8_t bit = 0; bit < 8; bit++)
            crc = crc & 0x80 ? (uint8_t)(crc << 1) ^ 0x07 : crc << 1;
    }
    return crc;
}

static char hex(uint8_t nibble)
{
    return nibble < 10 ? '0' + nibble : 'A' + nibble - 10;
}

void line_open(void)
{
    filled = 0;
}

void line_text_P(const char *text)
{
    strcpy_P(out + filled, text);
    filled += strlen_P(text);
}

void line_number(uint32_t number)
{
    char digits[10];
    uint8_t count = 0;

    do {
        digits[count++] = '0' + number % 10;
        number /= 10;
    } while (number);
    out[filled++] = ' ';
    while (count)
        out[filled++] = digits[--count];
}

void line_close(bool crc)
{
    if (crc) {
        uint8_t sum = crc8(out, filled);

        out[filled++] = '*';
        out[filled++] = hex(sum >> 4);
        out[filled++] = hex(sum & 15);
    }
    out[filled++] = '\n';
    out[filled] = 0;
    serial_write(out);
}

enum crc_check line_check(char *line, uint8_t length)
{
    static const char digits[] PROGMEM = "0123456789ABCDEF";
    uint8_t sum;

    if (length < 3 || line[length - 3] != '*' || !strchr_P(digits, line[length - 2]) ||
        !strchr_P(digits, line[length - 1]))
        return CRC_NONE;
    length -= 3;
    sum = crc8(line, length);
    if (line[length + 1] != hex(sum >> 4) || line[length + 2] != hex(sum & 15))
        return CRC_WRONG;
    line[length] = 0;
    return CRC_RIGHT;
}

bool line_take(const char **at, uint32_t limit, uint32_t *number, bool *too_large)
{
    const char *start = *at;
    uint32_t value = 0;

    while (**at >= '0' && **at <= '9') {
        uint8_t digit = *(*at)++ - '0';

        if (digit > limit || value > (limit - digit) / 10)
            *too_large = true;
        else
            value = value * 10 + digit;
    }
    *number = value;
    return *at != start;
}
