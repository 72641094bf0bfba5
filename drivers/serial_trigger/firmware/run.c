/* See run.h. What must be exact is done by the timer: an edge of VSYNC is stamped by input capture, and the camera
 * lines are driven by output compare, so no interrupt's delay shows in them. The interrupts only say what comes next,
 * and have the shortest dark time or exposure (50 us) for that.
 *
 *     idle --arm--> armed --edge, fire--> dark --> expose --+--> dark ...      (the next step follows)
 *       ^                                                   +--> wait --edge--> dark ...
 *       +------- last fall, stop, fault -------------------<+
 */
#include "run.h"

#include <avr/interrupt.h>
#include <util/atomic.h>

#include "clock.h"

enum phase { IDLE, ARMED, DARK, EXPOSE, WAIT };

struct step {
    uint32_t dark, exposure; /* ticks */
    uint8_t outputs, edges;
    uint8_t ahead; /* edges of the next step that waits for some; 0: none does */
    bool wraps;    /* that step is in the next pass */
};

/* A compare match lies at most a lap of the timer ahead. Longer times are walked in strides that leave, for the last
 * one, more time than any interrupt takes. */
#define REACH 60000U
#define STRIDE 30000U
#define MARGIN 6 /* ticks in which a compare can still be set */

static struct step steps[STEPS_MAX];
static uint8_t length;
static uint16_t passes = 1;
static uint8_t source = SOURCE_INT;
static uint32_t timeout;

static volatile uint8_t phase = IDLE;
static volatile uint8_t index_;
static volatile uint16_t pass;
static volatile uint8_t edges, wanted; /* counted from the edge that began a step; wanted 0: none */
static volatile uint32_t last_edge, free_since;
static uint32_t target, hop; /* the coming change of the outputs, and the compare match on the way to it */
static uint8_t level;        /* outputs after `target` */

static struct event events[EVENTS_MAX];
static volatile uint32_t pulses;
static volatile uint8_t last_fault;
static volatile bool news;
static volatile struct fault_report report;

/* --- outputs ---------------------------------------------------------------------------------------------------- */

/* What the next match does to the camera lines: in the end they take `outputs`, on the way they stay as they are. */
static void match_sets(uint8_t outputs)
{
    uint8_t com = _BV(COM1A1) | _BV(COM1B1); /* clear */

    if (outputs & OUT_CAM1)
        com |= _BV(COM1A0); /* set */
    if (outputs & OUT_CAM2)
        com |= _BV(COM1B0);
    TCCR1A = com;
}

static void soft_outputs(uint8_t outputs)
{
    if (outputs & OUT_SYNC)
        PORTD |= _BV(SYNC_BIT);
    else
        PORTD &= ~_BV(SYNC_BIT);
    if (outputs & OUT_LED)
        PORTB |= _BV(LED_BIT);
    else
        PORTB &= ~_BV(LED_BIT);
}

static void outputs_low(void)
{
    match_sets(0);
    TCCR1C = _BV(FOC1A) | _BV(FOC1B); /* a match by command: low now */
    soft_outputs(0);
}

/* --- steps; interrupts are off in all of these ------------------------------------------------------------------- */

static void fail(uint8_t fault, uint32_t ticks)
{
    outputs_low();
    phase = IDLE;
    last_fault = fault;
    report.ticks = ticks;
    report.pass = pass;
    report.step = index_;
    report.fault = fault;
    news = true;
}

static void next_index(void)
{
    if (++index_ == length) {
        index_ = 0;
        pass++;
    }
}

/* Set the compare for `target`, or for a stride towards it, seen from `from`. */
static void aim(uint32_t from)
{
    bool last = target - from <= REACH;

    hop = last ? target : from + STRIDE;
    OCR1A = (uint16_t)hop - 1; /* the outputs change one tick after the match */
    OCR1B = (uint16_t)hop - 1;
    if (last)
        match_sets(level);
    if ((int32_t)(hop - clock_now()) < MARGIN)
        fail(FAULT_OVERRUN, hop); /* the board itself was late: told as such, never passed over */
}

static void begin(uint32_t ticks)
{
    const struct step *step = &steps[index_];

    wanted = step->wraps && passes && pass + 1U == passes ? 0 : step->ahead;
    target = ticks + step->dark;
    level = step->outputs;
    phase = DARK;
    aim(ticks);
}

static void rise(void)
{
    const struct step *step = &steps[index_];

    phase = EXPOSE;
    soft_outputs(step->outputs);
    if (step->outputs) {
        struct event *event = &events[pulses % EVENTS_MAX];

        event->ticks = target;
        event->pass = pass;
        event->step = index_;
        pulses++;
        news = true;
    }
    level = 0;
    target += step->exposure;
    aim(hop);
}

static void fall(void)
{
    soft_outputs(0);
    free_since = target;
    next_index();
    if (index_ == 0 && passes && pass == passes) {
        phase = IDLE;
        return;
    }
    if (source == SOURCE_INT || steps[index_].edges == 0)
        begin(free_since);
    else
        phase = WAIT;
}

static void edge(uint32_t ticks)
{
    if (phase == IDLE)
        return;
    if (phase == EXPOSE && hop == target && (int32_t)(ticks - target) >= 0)
        fall(); /* its match came first, its interrupt waits */
    last_edge = ticks;
    edges++;
    if (wanted == 0 || edges != wanted || phase == IDLE)
        return;
    if (phase == ARMED || (phase == WAIT && (int32_t)(ticks - free_since) >= 0)) {
        edges = 0;
        begin(ticks);
    } else {
        if (phase != WAIT)
            next_index();
        fail(FAULT_OVERRUN, ticks);
    }
}

ISR(TIMER1_COMPA_vect)
{
    /* The match comes again every lap, and once more where `edge` has been faster: those mean nothing. */
    if ((phase != DARK && phase != EXPOSE) || (int32_t)(clock_now() - hop) < 0)
        return;
    if (hop != target)
        aim(hop);
    else if (phase == DARK)
        rise();
    else
        fall();
}

ISR(TIMER1_CAPT_vect)
{
    edge(clock_at(ICR1));
}

ISR(INT0_vect)
{
    edge(clock_now());
}

/* --- for the main loop -------------------------------------------------------------------------------------------- */

void run_start(void)
{
    PORTB &= ~(_BV(CAM1_BIT) | _BV(CAM2_BIT) | _BV(LED_BIT));
    PORTD &= ~_BV(SYNC_BIT);
    outputs_low();
    DDRB |= _BV(CAM1_BIT) | _BV(CAM2_BIT) | _BV(LED_BIT);
    DDRD |= _BV(SYNC_BIT);
    PORTB |= _BV(VSYNC_BIT); /* an open input must not count edges */
    PORTD |= _BV(EXT_BIT);
    TIMSK1 |= _BV(OCIE1A);
    run_clear();
    run_repeat(1);
    run_source(SOURCE_INT, false);
}

void run_clear(void)
{
    length = 0;
}

bool run_add(uint32_t dark_us, uint32_t exposure_us, uint8_t outputs, uint8_t edges_)
{
    struct step *step = &steps[length];

    if (length == STEPS_MAX)
        return false;
    step->dark = dark_us * TICKS_PER_US;
    step->exposure = exposure_us * TICKS_PER_US;
    step->outputs = outputs;
    step->edges = edges_;
    length++;
    return true;
}

uint8_t run_length(void)
{
    return length;
}

void run_repeat(uint16_t passes_)
{
    passes = passes_;
}

void run_source(enum source source_, bool falling)
{
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        TIMSK1 &= ~_BV(ICIE1);
        EIMSK &= ~_BV(INT0);
        source = source_;
        if (falling)
            TCCR1B &= ~_BV(ICES1);
        else
            TCCR1B |= _BV(ICES1);
        EICRA = falling ? _BV(ISC01) : _BV(ISC01) | _BV(ISC00);
        /* Its interrupt stays on, and means nothing while idle: so no edge from before can wait for the arming. */
        if (source_ == SOURCE_VSYNC)
            TIMSK1 |= _BV(ICIE1);
        else if (source_ == SOURCE_EXT)
            EIMSK |= _BV(INT0);
    }
    run_timeout(source_ == SOURCE_VSYNC ? VSYNC_TIMEOUT_MS : 0);
}

void run_timeout(uint16_t ms)
{
    timeout = ms * TICKS_PER_MS;
}

/* What each step needs to know of those after it, so that the interrupts need not look. */
static void look_ahead(void)
{
    for (uint8_t i = 0; i < length; i++) {
        uint8_t j = i;

        steps[i].wraps = false;
        do {
            if (++j == length) {
                j = 0;
                steps[i].wraps = true;
            }
        } while (j != i && steps[j].edges == 0);
        steps[i].ahead = source == SOURCE_INT ? 0 : steps[j].edges;
    }
}

void run_arm(void)
{
    look_ahead();
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        index_ = 0;
        pass = 0;
        edges = 0;
        pulses = 0;
        last_fault = FAULT_NONE;
        report.fault = FAULT_NONE;
        wanted = source == SOURCE_INT ? 0 : steps[0].edges ? steps[0].edges : 1;
        last_edge = clock_now();
        phase = ARMED;
    }
}

bool run_fire(void)
{
    bool fired = false;

    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        if (phase == ARMED && source == SOURCE_INT) {
            begin(clock_now());
            fired = true;
        }
    }
    return fired;
}

void run_stop(void)
{
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        phase = IDLE;
        outputs_low();
    }
}

void run_poll(void)
{
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        bool waits = phase == WAIT || (phase == ARMED && source != SOURCE_INT);

        if (timeout && waits && clock_now() - last_edge > timeout)
            fail(FAULT_NOEDGE, last_edge + timeout);
    }
}

enum run_state run_state(void)
{
    uint8_t now = phase;

    return now == IDLE ? RUN_IDLE : now == ARMED ? RUN_ARMED : RUN_RUNNING;
}

uint32_t run_pulses(void)
{
    uint32_t count;

    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        count = pulses;
    }
    return count;
}

enum fault run_last_fault(void)
{
    return last_fault;
}

bool run_news(void)
{
    return news;
}

void run_heard(void)
{
    news = false;
}

bool run_event(uint32_t number, struct event *event)
{
    bool kept;

    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        kept = number < pulses && pulses - number <= EVENTS_MAX;
        if (kept)
            *event = events[number % EVENTS_MAX];
    }
    return kept;
}

bool run_take_fault(struct fault_report *taken)
{
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        *taken = report;
        report.fault = FAULT_NONE;
    }
    return taken->fault != FAULT_NONE;
}
