/* See serial.h. */
#include "serial.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <util/atomic.h>

#include "clock.h"
#include "run.h"

#define BAUD 115200UL
#define BAUD_TOL 3 /* 117647 is what 16 MHz gives: 2.1 % fast, which both ends bear, as every Arduino of this kind */
#include <util/setbaud.h>

#define RX_SIZE 128 /* powers of two */
#define TX_SIZE 256

static volatile uint8_t rx[RX_SIZE];
static volatile uint8_t rx_in, rx_out;
static volatile bool rx_broken;
static volatile uint32_t line_ticks;

static volatile uint8_t tx[TX_SIZE];
static volatile uint8_t tx_in, tx_out;

void serial_start(void)
{
    UCSR0A = USE_2X ? _BV(U2X0) : 0;
    UBRR0 = UBRR_VALUE;
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);
    UCSR0B = _BV(RXEN0) | _BV(TXEN0) | _BV(RXCIE0);
}

ISR(USART_RX_vect)
{
    bool damaged = UCSR0A & (_BV(FE0) | _BV(DOR0));
    uint8_t byte = UDR0;
    uint8_t next = (rx_in + 1) % RX_SIZE;

    if (byte == SERIAL_ABORT)
        run_stop();
    if (byte == '\n')
        line_ticks = clock_now();
    if (damaged || next == rx_out) {
        rx_broken = true;
        return;
    }
    rx[rx_in] = byte;
    rx_in = next;
}

ISR(USART_UDRE_vect)
{
    UDR0 = tx[tx_out];
    tx_out = (uint8_t)(tx_out + 1) % TX_SIZE;
    if (tx_out == tx_in)
        UCSR0B &= ~_BV(UDRIE0);
}

bool serial_idle(void)
{
    return rx_in == rx_out && !rx_broken;
}

int16_t serial_read(void)
{
    int16_t byte = -1;

    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        if (rx_in != rx_out) {
            byte = rx[rx_out];
            rx_out = (rx_out + 1) % RX_SIZE;
        } else if (rx_broken) {
            rx_broken = false;
            byte = SERIAL_BROKEN;
        }
    }
    return byte;
}

uint32_t serial_line_ticks(void)
{
    uint32_t ticks;

    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        ticks = line_ticks;
    }
    return ticks;
}

uint8_t serial_room(void)
{
    return (uint8_t)(tx_out - tx_in - 1);
}

void serial_write(const char *text)
{
    for (; *text; text++) {
        while (serial_room() == 0)
            ;
        tx[tx_in] = *text;
        ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
        {
            tx_in = (uint8_t)(tx_in + 1) % TX_SIZE;
            UCSR0B |= _BV(UDRIE0);
        }
    }
}
