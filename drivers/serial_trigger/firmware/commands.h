/* What the board answers and what it says by itself. */
#ifndef COMMANDS_H
#define COMMANDS_H

#include <stdbool.h>

void commands_ready(void);  /* "!EVT READY", after a reset */
void commands_read(void);   /* take what has arrived, answer whole lines */
bool commands_report(void); /* say a fault or an event; false: nothing was to say, or the line has no room yet */

#endif
