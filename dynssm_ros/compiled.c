/* Loops of the predictor's step, and of the simulations of a fit, over arrays that Python has allocated. dynssm_ros/compiled.py opens it; each function has its
   counterpart in numpy, to which a test holds it. The car's equations are not here: they come as a tape of operations
   (dynssm_ros/vehicle/tape.py). */
#include <math.h>
#include <stdint.h>
#include <string.h>

#define LANES 32 /* rows that an operation is executed for at once; compiled.py knows it */
#define CHANNELS 3
#define COLUMNS 7
#ifndef SOURCE
#define SOURCE ""
#endif

typedef struct {
    const int32_t *code; /* (operations, 4): operation, result, operands */
    int64_t operations;
    double *work; /* (slots, LANES), with the constants in their places */
    const int32_t *outputs;
    int64_t count; /* of the outputs */
} Tape;

typedef struct {
    Tape step;   /* v_x, v_y, omega, r, delta, effect states -> increments */
    Tape settle; /* v_x, v_y, omega, r, delta, r_fb, delta_fb -> effect states */
    Tape carry;  /* as step -> effect states at the next row */
    int64_t states;
    double *along; /* (H, states, LANES) */
} Car;

typedef struct {
    Car car;
    int64_t rows, recent, input_lags, errors, network, throttles, n;
    const int64_t *places; /* (CHANNELS, n) */
    const double *mean, *std, *scale, *input_scale;
    const double *throttle, *throttle_width; /* of steps (throttles) */
    double *moved;                           /* (LANES, errors + 1, CHANNELS) */
    double *found; /* all features of a window, before they are placed */
} Features;

typedef struct {
    Features features;
    int64_t steps, mean_error; /* place of that feature */
    int64_t judged;            /* whether states are kept within `far`, as paths that are judged are */
    double far, minimum_speed, least, fading; /* share of the correction that a step takes off, after the first horizon */
    double *moved;    /* (LANES, errors + steps, CHANNELS) */
    double *now;      /* features of a window (CHANNELS, n) */
    double *constant; /* the physics' mean error at the start (LANES, CHANNELS) */
} Rollout;

typedef struct {
    int64_t n;
    double *mean, *covariance, *noise, *physics, *recent, *width, *spread;
    const double *returning, *widening, *scale;
    double retained, forget, recently, outlier, quantile, missed_grows, hit_shrinks, widest, largest, smallest_recent,
        smallest_noise, limit;
} Layer;

typedef struct {
    Features features;
    double minimum_speed, least;
    const double *alone; /* variances of what the physics alone says (CHANNELS) */
} Step;

typedef struct {
    Tape settle; /* signals, parameters -> effect states */
    Tape step;   /* signals, effect states, parameters -> state and effect states at the next row */
    int64_t signals; /* the measured state, both inputs, what effects read beside them */
    int64_t states, parameters;
    const int64_t *signal_places; /* (signals, 2): where the first row's number lies, numbers between rows */
    const int64_t *settling;      /* the same with the inputs' feedback, under which effect states settle */
    const int64_t *parameter_places; /* (parameters, 3): where the first one lies, numbers between cars and windows */
    int64_t cars, windows;
    const int64_t *starts; /* (windows) rows */
    int64_t begin, steps, every; /* rows from the starts at which a simulation begins and ends; which rows are kept */
    double taken; /* share of the measured row that the state takes until the start */
    double *next; /* (CHANNELS + states, LANES) */
} Simulation;

const char *dynssm_source(void) { return SOURCE; }

/* glibc has elementary functions of several numbers at once, right to four units in the last digit. So that a number does not
   depend on its lane, operations are executed for whole groups of lanes there, though nobody reads the rest. */
#if defined(__GNUC__) && !defined(__clang__) && defined(__x86_64__) && defined(__GLIBC__)
#if __GLIBC_PREREQ(2, 35)
#define GROUP 4
#define WIDE __attribute__((target_clones("avx2", "default")))
#define AT_ONCE(...) extern double __VA_ARGS__ __attribute__((simd("notinbranch")));
AT_ONCE(sin(double)) AT_ONCE(cos(double)) AT_ONCE(tan(double)) AT_ONCE(atan(double)) AT_ONCE(atan2(double, double))
AT_ONCE(tanh(double)) AT_ONCE(exp(double)) AT_ONCE(hypot(double, double)) AT_ONCE(pow(double, double))
#endif
#endif
#ifndef WIDE
#define GROUP 1
#define WIDE
#endif

#define EACH(expression)                         \
    _Pragma("GCC ivdep")                         \
    for (int64_t i = 0; i < lanes; i++) {        \
        const double a = x[i], b = y[i];         \
        (void)b;                                 \
        z[i] = (expression);                     \
    }                                            \
    break

WIDE static void run(const Tape *tape, int64_t wanted) {
    const int64_t lanes = (wanted + GROUP - 1) / GROUP * GROUP;
    const int32_t *code = tape->code;
    for (int64_t k = 0; k < tape->operations; k++, code += 4) {
        double *z = tape->work + (int64_t)code[1] * LANES;
        const double *x = tape->work + (int64_t)code[2] * LANES, *y = tape->work + (int64_t)code[3] * LANES;
        switch (code[0]) {
        case 0: EACH(a + b);
        case 1: EACH(a - b);
        case 2: EACH(a * b);
        case 3: EACH(a / b);
        case 4: EACH(pow(a, b));
        case 5: EACH(-a);
        case 6: EACH(fabs(a));
        case 7: EACH(a < b ? 1.0 : 0.0);
        case 8: EACH(a <= b ? 1.0 : 0.0);
        case 9: EACH(sqrt(a));
        case 10: EACH(sin(a));
        case 11: EACH(cos(a));
        case 12: EACH(tan(a));
        case 13: EACH(atan(a));
        case 14: EACH(atan2(a, b));
        case 15: EACH(tanh(a));
        case 16: EACH(exp(a));
        case 17: EACH(hypot(a, b));
        }
    }
}

/* Executes a tape so many `times` for one row, which all lanes that run() computes hold, its results each time in the place of
   its first inputs. */
void dynssm_repeat(const Tape *tape, int64_t times) {
    double *work = tape->work;
    for (int64_t k = 0; k < times; k++) {
        run(tape, 1);
        for (int64_t j = 0; j < tape->count; j++) /* a result may lie where another one goes */
            work[j * LANES + LANES - 1] = work[(int64_t)tape->outputs[j] * LANES];
        for (int64_t j = 0; j < tape->count; j++)
            for (int64_t i = 0; i < GROUP; i++) work[j * LANES + i] = work[j * LANES + LANES - 1];
    }
}

/* Puts a window's row into a lane: state and applied inputs. */
static inline void enter(double *work, int64_t lane, const double *row) {
    work[lane] = row[0];
    work[LANES + lane] = row[1];
    work[2 * LANES + lane] = row[2];
    work[3 * LANES + lane] = row[3] + row[5];
    work[4 * LANES + lane] = row[4] + row[6];
}

/* Increments (count, latest, CHANNELS) from the latest rows of at most LANES windows (rows, COLUMNS), `apart` numbers apart. */
static void over(const Car *car, const double *windows, int64_t apart, int64_t count, int64_t rows, int64_t latest,
                 double *moved) {
    const int64_t first = rows - latest, states = car->states;
    if (states) {
        const Tape *settle = &car->settle, *carry = &car->carry;
        for (int64_t w = 0; w < count; w++) {
            const double *row = windows + w * apart;
            enter(settle->work, w, row);
            settle->work[5 * LANES + w] = row[3];
            settle->work[6 * LANES + w] = row[4];
        }
        run(settle, count);
        for (int64_t s = 0; s < states; s++)
            memcpy(car->along + s * LANES, settle->work + (int64_t)settle->outputs[s] * LANES, LANES * sizeof(double));
        for (int64_t k = 0; k + 1 < rows; k++) {
            double *at = car->along + k * states * LANES;
            for (int64_t w = 0; w < count; w++) enter(carry->work, w, windows + w * apart + k * COLUMNS);
            memcpy(carry->work + 5 * LANES, at, states * LANES * sizeof(double));
            run(carry, count);
            at += states * LANES;
            for (int64_t s = 0; s < states; s++)
                memcpy(at + s * LANES, carry->work + (int64_t)carry->outputs[s] * LANES, LANES * sizeof(double));
        }
    }
    const Tape *step = &car->step;
    for (int64_t begin = 0; begin < count * latest; begin += LANES) {
        const int64_t lanes = count * latest - begin < LANES ? count * latest - begin : LANES;
        for (int64_t i = 0; i < lanes; i++) {
            const int64_t w = (begin + i) / latest, k = first + (begin + i) % latest;
            enter(step->work, i, windows + w * apart + k * COLUMNS);
            for (int64_t s = 0; s < states; s++)
                step->work[(5 + s) * LANES + i] = car->along[(k * states + s) * LANES + w];
        }
        run(step, lanes);
        for (int64_t i = 0; i < lanes; i++)
            for (int64_t c = 0; c < CHANNELS; c++)
                moved[(begin + i) * CHANNELS + c] = step->work[(int64_t)step->outputs[c] * LANES + i];
    }
}

void dynssm_over(const Car *car, const double *windows, int64_t count, int64_t rows, int64_t latest, double *moved) {
    for (int64_t w = 0; w < count; w += LANES)
        over(car, windows + w * rows * COLUMNS, rows * COLUMNS, count - w < LANES ? count - w : LANES, rows, latest,
             moved + w * latest * CHANNELS);
}

/* What the layer sees of a window whose physics (errors + 1, CHANNELS) is known: features (CHANNELS, n). */
static void seen(const Features *f, const double *window, const double *moved, const double *network, double *features) {
    const int64_t rows = f->rows, errors = f->errors;
    const double *last = window + (rows - 1) * COLUMNS, *physics = moved + errors * CHANNELS;
    double *at = f->found;
    for (int64_t c = 0; c < CHANNELS; c++) *at++ = physics[c] / f->scale[c];
    for (int64_t k = rows - f->recent; k < rows; k++)
        for (int64_t c = 0; c < CHANNELS; c++)
            *at++ = (window[k * COLUMNS + c] - window[(k - 1) * COLUMNS + c]) / f->scale[c];
    for (int64_t k = rows - f->input_lags; k < rows; k++)
        for (int64_t u = 3; u < 5; u++) {
            const double *now = window + k * COLUMNS + u, *before = now - COLUMNS;
            *at++ = ((now[0] + now[2]) - (before[0] + before[2])) / f->input_scale[u - 3];
        }
    for (int64_t k = 0; k < 5; k++) *at++ = (last[k] - f->mean[k]) / f->std[k];
    for (int64_t c = 0; c < CHANNELS; c++) {
        double measured = 0.0, predicted = 0.0;
        for (int64_t k = 0; k < errors; k++) {
            const double *row = window + (rows - errors + k) * COLUMNS + c;
            measured += (row[0] - row[-COLUMNS]) / f->scale[c];
            predicted += moved[k * CHANNELS + c];
        }
        *at++ = measured / errors - predicted / errors / f->scale[c];
    }
    if (network)
        for (int64_t c = 0; c < CHANNELS; c++) *at++ = network[c] / f->scale[c];
    *at++ = 1.0;
    for (int64_t k = 0; k < f->throttles; k++)
        *at++ = tanh((last[3] + last[5] - f->throttle[k]) / f->throttle_width[k]);
    for (int64_t k = 0; k < CHANNELS * f->n; k++) features[k] = f->found[f->places[k]];
}

/* Features (count, CHANNELS, n) and the physics' increments (count, CHANNELS) of windows (count, rows, COLUMNS). */
void dynssm_seen(const Features *f, const double *windows, int64_t count, const double *network, double *features,
                 double *physics) {
    const int64_t latest = f->errors + 1, size = f->rows * COLUMNS;
    for (int64_t begin = 0; begin < count; begin += LANES) {
        const int64_t some = count - begin < LANES ? count - begin : LANES;
        over(&f->car, windows + begin * size, size, some, f->rows, latest, f->moved);
        for (int64_t w = 0; w < some; w++) {
            const double *moved = f->moved + w * latest * CHANNELS;
            seen(f, windows + (begin + w) * size, moved, network ? network + (begin + w) * CHANNELS : 0,
                 features + (begin + w) * CHANNELS * f->n);
            memcpy(physics + (begin + w) * CHANNELS, moved + f->errors * CHANNELS, CHANNELS * sizeof(double));
        }
    }
}

/* Covariance (n, n) times features (n). As it is symmetric, its rows are added up, several numbers at once. */
WIDE static void spread_of(const double *covariance, const double *features, int64_t n, double *restrict spread) {
    memset(spread, 0, n * sizeof(double));
    for (int64_t j = 0; j < n; j++, covariance += n)
        for (int64_t i = 0; i < n; i++) spread[i] += covariance[i] * features[j];
}

/* What is known before a step: weights (CHANNELS, n), the variances that OnlineState.variance computes and the limits (CHANNELS). */
static void known(const Layer *layer, const double *features, double *weights, double *stated, double *limits) {
    const int64_t n = layer->n;
    memcpy(weights, layer->mean, CHANNELS * n * sizeof(double));
    for (int64_t c = 0; c < CHANNELS; c++) {
        const double *f = features + c * n;
        double explained = 0.0;
        spread_of(layer->covariance + c * n * n, f, n, layer->spread);
        for (int64_t i = 0; i < n; i++) explained += layer->spread[i] * f[i];
        limits[c] = layer->limit * sqrt(layer->physics[c]);
        stated[c] = layer->width[c] * layer->width[c] * layer->recent[c] * (layer->noise[c] + explained);
    }
}

/* The same one after the other. */
void dynssm_known(const Layer *layer, const double *features, double *found) {
    const int64_t size = CHANNELS * layer->n;
    known(layer, features, found, found + size, found + size + CHANNELS);
}

/* A row of the covariance: what a step says is taken off, and a share of the prior's comes back. */
WIDE static void less(double *restrict row, double gain, const double *spread, int64_t n, double kept,
                      const double *widening) {
    for (int64_t j = 0; j < n; j++) row[j] = kept * (row[j] - gain * spread[j]) + widening[j];
}

static inline double larger(double a, double b) { return a > b ? a : b; }
static inline double smaller(double a, double b) { return a < b ? a : b; }

/* Learns from a step: OnlineState.update. Returns whether it taught something. */
static int64_t update(Layer *layer, const double *features, const double *physics, const double *increment) {
    const int64_t n = layer->n;
    double target[CHANNELS], sum = 0.0;
    for (int64_t c = 0; c < CHANNELS; c++) sum += target[c] = increment[c] / layer->scale[c];
    for (int64_t k = 0; k < CHANNELS * n; k++) sum += features[k];
    if (!isfinite(sum)) return 0;
    for (int64_t c = 0; c < CHANNELS; c++) {
        double *P = layer->covariance + c * n * n, *mean = layer->mean + c * n, *spread = layer->spread;
        const double *f = features + c * n, *widening = layer->widening + c * n * n;
        const double *returning = layer->returning + c * n, noise = layer->noise[c], kept = layer->retained;
        double predicted = 0.0, said = 0.0;
        spread_of(P, f, n, spread);
        for (int64_t i = 0; i < n; i++) {
            predicted += spread[i] * f[i];
            said += mean[i] * f[i];
        }
        const double error = target[c] - said, size = fabs(error) / sqrt(noise + predicted);
        const double divisor = predicted + noise * larger(1.0, size / layer->outlier);
        for (int64_t i = 0; i < n; i++) {
            const double gain = spread[i] / divisor;
            mean[i] = kept * (mean[i] + gain * error) + returning[i];
            less(P + i * n, gain, spread, n, kept * kept, widening + i * n);
        }
        double *recent = layer->recent + c, *width = layer->width + c;
        const int missed = size > layer->quantile * *width * sqrt(*recent);
        *width = smaller(larger(*width * (missed ? layer->missed_grows : layer->hit_shrinks), 1.0 / layer->widest),
                         layer->widest);
        const double surprise = smaller(size * size, layer->largest * *recent);
        *recent = larger(*recent + layer->recently * (surprise - *recent), layer->smallest_recent);
        const double square = smaller(error * error * noise / (noise + predicted), layer->largest * noise);
        layer->noise[c] = larger(noise + layer->forget * (square - noise), layer->smallest_noise);
        const double of_physics = (increment[c] - physics[c]) / layer->scale[c];
        layer->physics[c] += layer->forget * (of_physics * of_physics - layer->physics[c]);
    }
    return 1;
}

int64_t dynssm_update(Layer *layer, const double *features, const double *physics, const double *increment) {
    return update(layer, features, physics, increment);
}

/* A row of a drive, of a model that is its physics and the layer: what the window (rows, COLUMNS) that ends with it shows, and
   what follows. Where it follows on a row with `before` (features) and `physics`, the layer learns that step first; returns
   whether that taught something. To row: features (CHANNELS, n) and weights (CHANNELS, n); the physics' increments, stated
   variances and limits as known() has them, the next state, its variances and the state by the physics (CHANNELS each). */
int64_t dynssm_step(const Step *s, Layer *layer, const double *window, const double *before, const double *physics,
                    double *row) {
    const Features *f = &s->features;
    const int64_t n = f->n;
    const double *now = window + (f->rows - 1) * COLUMNS, *last = now - COLUMNS;
    double *weights = row + CHANNELS * n, *moved = weights + CHANNELS * n, *stated = moved + CHANNELS;
    double *limits = stated + CHANNELS, *next = limits + CHANNELS, *variances = next + CHANNELS;
    double *by_physics = variances + CHANNELS;
    const double increment[CHANNELS] = {now[0] - last[0], now[1] - last[1], now[2] - last[2]};
    const int64_t taught = before && update(layer, before, physics, increment);
    const int acts = fabs(now[0]) >= s->minimum_speed && now[0] >= s->least;
    dynssm_seen(f, window, 1, 0, row, moved);
    known(layer, row, weights, stated, limits);
    for (int64_t c = 0; c < CHANNELS; c++) {
        const double scale = layer->scale[c];
        double said = 0.0;
        for (int64_t i = 0; i < n; i++) said += row[c * n + i] * weights[c * n + i];
        by_physics[c] = now[c] + moved[c];
        next[c] = acts ? now[c] + said * scale : by_physics[c];
        variances[c] = now[0] >= s->least ? stated[c] * (scale * scale) : s->alone[c];
    }
    return taught;
}

/* Learns along rows, each from the one before if it `follows`; what is known at each goes to weights (count, CHANNELS, n),
   stated and limits (count, CHANNELS), whether it taught something to taught (count). */
void dynssm_along(Layer *layer, const double *features, const double *physics, const double *increments, int64_t count,
                  const uint8_t *follows, uint8_t *taught, double *weights, double *stated, double *limits) {
    const int64_t size = CHANNELS * layer->n;
    for (int64_t k = 0; k < count; k++) {
        taught[k] = follows[k] && update(layer, features + (k - 1) * size, physics + (k - 1) * CHANNELS,
                                         increments + (k - 1) * CHANNELS);
        known(layer, features + k * size, weights + k * size, stated + k * CHANNELS, limits + k * CHANNELS);
    }
}

/* Predicts `steps` rows after the first f->rows of rows (count, f->rows + steps, COLUMNS), each from those before: what
   RolloutCorrection does of a model that is its physics and the layer. weights (count, CHANNELS, n), limits (count, CHANNELS)
   and trusted (count) are what was known at the start. */
void dynssm_rollout(const Rollout *r, double *all, int64_t count, const double *weights, const double *limits,
                    const double *trusted) {
    const Features *f = &r->features;
    const int64_t H = f->rows, apart = (H + r->steps) * COLUMNS, n = f->n, errors = f->errors;
    const int64_t kept_rows = (errors + r->steps) * CHANNELS, states = f->car.states;
    for (int64_t begin = 0; begin < count; begin += LANES) {
        const int64_t some = count - begin < LANES ? count - begin : LANES;
        double *rows = all + begin * apart;
        for (int64_t s = 0; s < r->steps; s++) {
            if (s == 0 || states) { /* effect states depend on where a window begins */
                over(&f->car, rows + s * COLUMNS, apart, some, H, errors + 1, f->moved);
                for (int64_t w = 0; w < some; w++)
                    memcpy(r->moved + w * kept_rows + s * CHANNELS, f->moved + w * (errors + 1) * CHANNELS,
                           (errors + 1) * CHANNELS * sizeof(double));
            } else {
                const Tape *step = &f->car.step;
                for (int64_t w = 0; w < some; w++) enter(step->work, w, rows + w * apart + (H - 1 + s) * COLUMNS);
                run(step, some);
                for (int64_t w = 0; w < some; w++)
                    for (int64_t c = 0; c < CHANNELS; c++)
                        r->moved[w * kept_rows + (errors + s) * CHANNELS + c] =
                            step->work[(int64_t)step->outputs[c] * LANES + w];
            }
            const double kept = smaller(larger(2.0 - s * r->fading, 0.0), 1.0);
            for (int64_t w = 0; w < some; w++) {
                const double *window = rows + w * apart + s * COLUMNS, *now = window + (H - 1) * COLUMNS;
                const double *moved = r->moved + w * kept_rows + s * CHANNELS, *physics = moved + errors * CHANNELS;
                double *next = rows + w * apart + (H + s) * COLUMNS;
                const int acts = fabs(now[0]) >= r->minimum_speed && now[0] >= r->least;
                seen(f, window, moved, 0, r->now);
                for (int64_t c = 0; c < CHANNELS; c++) {
                    const double *own = weights + ((begin + w) * CHANNELS + c) * n, *feature = r->now + c * n;
                    double *constant = r->constant + w * CHANNELS + c;
                    double said = 0.0;
                    for (int64_t i = 0; i < n; i++) said += feature[i] * own[i];
                    said *= f->scale[c];
                    if (s == 0) {
                        *constant = feature[r->mean_error] * f->scale[c];
                    } else {
                        const double bound = limits[(begin + w) * CHANNELS + c] * f->scale[c], off = said - physics[c];
                        const double held = off < -bound ? -bound : off > bound ? bound : off;
                        said = physics[c] + kept * (trusted[begin + w] > 0.0 ? physics[c] + held - physics[c] : *constant);
                    }
                    double state = now[c] + (acts || r->judged ? said : physics[c]);
                    if (r->judged) state = isnan(state) ? r->far : smaller(larger(state, -r->far), r->far);
                    next[c] = state;
                }
            }
        }
    }
}

/* Values at the times `offsets` after `now` (rows) of a signal whose samples are in a ring buffer, COLUMNS apart: linear between
   samples as numpy's interp, held beyond them; of one that is held the last value at or before a `slack` later. `place`: where
   its oldest sample's time and value lie, their number, whether it is held. A brake takes the place of the throttle where it
   is pressed. */
static void sample(const int64_t *place, const double *offsets, double now, double slack, int64_t rows, double *column,
                   int brake) {
    const double *t = (const double *)(intptr_t)place[0], *v = (const double *)(intptr_t)place[1];
    const int64_t last = place[2] - 1, held = place[3];
    int64_t j = last; /* times ascend, and the newest rows are asked for: back from the newest sample */
    for (int64_t k = rows - 1; k >= 0; k--) {
        const double grid = offsets[k] + now, x = held ? grid + slack : grid;
        while (j > 0 && t[j] > x) j--;
        double value = v[j];
        if (!(held || j == last || t[j] >= x)) {
            const double slope = (v[j + 1] - v[j]) / (t[j + 1] - t[j]);
            value = slope * (x - t[j]) + v[j];
        }
        if (!brake)
            column[k * COLUMNS] = value;
        else if (value > 0.0)
            column[k * COLUMNS] = -value;
    }
}

/* The window (rows, COLUMNS) of a history: what History.window samples and model_inputs makes of it. Signals have a row of
   `places` each: the state, then throttle, brake and steering of the feedback and of the commands; those that there are not
   have no samples. */
void dynssm_window(const int64_t *places, const double *offsets, double now, double slack, int64_t rows, double *window) {
    static const int64_t columns[] = {0, 1, 2, 3, 3, 4, 5, 5, 6}, brakes[] = {0, 0, 0, 0, 1, 0, 0, 1, 0};
    const int64_t commands = places[6 * 4 + 2];
    for (int64_t s = 0; s < 9; s++)
        if (places[4 * s + 2]) sample(places + 4 * s, offsets, now, slack, rows, window + columns[s], (int)brakes[s]);
    for (int64_t k = 0; k < rows; k++)
        for (int64_t u = 3; u < 5; u++) {
            double *row = window + k * COLUMNS + u;
            row[2] = commands ? row[2] - row[0] : 0.0;
        }
}

/* Puts the signals from number `first` on, `k` rows after the starts of some lanes, into a tape. */
static void read_signals(const Simulation *s, const int64_t *places, double *work, int64_t first, const int64_t *starts,
                         int64_t lanes, int64_t k) {
    for (int64_t j = first; j < s->signals; j++) {
        const double *values = (const double *)(intptr_t)places[2 * j];
        const int64_t apart = places[2 * j + 1];
        for (int64_t i = 0; i < lanes; i++) work[j * LANES + i] = values[(starts[i] + k) * apart];
    }
}

static void read_parameters(const Simulation *s, double *work, const int64_t *cars, const int64_t *windows, int64_t lanes) {
    for (int64_t j = 0; j < s->parameters; j++) {
        const int64_t *place = s->parameter_places + 3 * j;
        const double *values = (const double *)(intptr_t)place[0];
        for (int64_t i = 0; i < lanes; i++) work[j * LANES + i] = values[cars[i] * place[1] + windows[i] * place[2]];
    }
}

/* Simulates each car from each start; the kept rows go to out (cars, windows, steps / every, CHANNELS), whose cars are `apart`
   numbers apart. What SimulationWindows computes in numpy. */
void dynssm_simulate(const Simulation *s, double *out, int64_t apart) {
    const Tape *settle = &s->settle, *step = &s->step;
    const int64_t results = CHANNELS + s->states, kept = s->steps / s->every * CHANNELS;
    int64_t cars[LANES], windows[LANES], starts[LANES];
    double *work = step->work, *own = work + s->signals * LANES;
    for (int64_t lane = 0; lane < s->cars * s->windows; lane += LANES) {
        const int64_t left = s->cars * s->windows - lane, lanes = left < LANES ? left : LANES;
        for (int64_t i = 0; i < lanes; i++) {
            cars[i] = (lane + i) / s->windows;
            windows[i] = (lane + i) % s->windows;
            starts[i] = s->starts[windows[i]];
        }
        if (s->states) {
            read_signals(s, s->settling, settle->work, 0, starts, lanes, s->begin);
            read_parameters(s, settle->work + s->signals * LANES, cars, windows, lanes);
            run(settle, lanes);
            for (int64_t j = 0; j < s->states; j++)
                memcpy(own + j * LANES, settle->work + (int64_t)settle->outputs[j] * LANES, LANES * sizeof(double));
        }
        read_parameters(s, own + s->states * LANES, cars, windows, lanes);
        read_signals(s, s->signal_places, work, 0, starts, lanes, s->begin);
        for (int64_t k = s->begin; k < s->steps; k++) {
            read_signals(s, s->signal_places, work, CHANNELS, starts, lanes, k);
            if (k <= 0)
                for (int64_t c = 0; c < CHANNELS; c++) {
                    const double *measured = (const double *)(intptr_t)s->signal_places[2 * c];
                    double *led = work + c * LANES;
                    for (int64_t i = 0; i < lanes; i++)
                        led[i] += s->taken * (measured[(starts[i] + k) * s->signal_places[2 * c + 1]] - led[i]);
                }
            run(step, lanes);
            for (int64_t j = 0; j < results; j++) /* a result may lie where another one goes */
                memcpy(s->next + j * LANES, work + (int64_t)step->outputs[j] * LANES, LANES * sizeof(double));
            memcpy(work, s->next, CHANNELS * LANES * sizeof(double));
            memcpy(own, s->next + CHANNELS * LANES, s->states * LANES * sizeof(double));
            if (k >= 0 && (k + 1) % s->every == 0)
                for (int64_t i = 0; i < lanes; i++) {
                    double *there = out + cars[i] * apart + windows[i] * kept + k / s->every * CHANNELS;
                    for (int64_t c = 0; c < CHANNELS; c++) there[c] = work[c * LANES + i];
                }
        }
    }
}
