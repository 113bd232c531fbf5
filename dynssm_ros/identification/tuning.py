"""Tuned constants of calibration and diagnosis: unit, why this value, and what exercises it.

In brackets: a file of ``test/identification`` or the benchmark ``hidden_causes`` (*causes*), which counts how many causes are
named and how many are invented; *time*: it saves time alone. Thresholds of evidence are those of the literature, where it
has some. Guards against division by zero are not tuned and stay where they are.
"""

from scipy import special

# What is known before
MASS_STD = 0.01  # of the mass, where the vehicle file does not say: a workshop's scales [test_known_before, causes]
MASS_RANGE = 10.0  # times heavier or lighter than nominal, at most: no more than a bound
INSIDE_BOUNDS = 1e-3  # of its range that a coefficient stays from its bounds, where logarithms end [test_windows]
EFFECT_UNIT = 0.1  # of the way from neutral to the upper bound: in this unit effects are fitted [test_windows]
EFFECT_STD = 10.0  # of these units that an effect is off as one standard deviation: nearly free [test_windows]

# Simulations along a recording
HORIZONS_S = (0.5, 0.25, 0.1)  # the first with enough stretches; longer ones amplify noise [test_calibration]
HOLDOUT = 0.25  # of each recording, that neither fit nor selection sees [test_diagnose]
HOLDOUT_RANGE = (0.05, 0.8)  # what may be asked for [test_bad_input]
WARM_UP_S = 0.64  # of measured rows before a start: four time constants of the observer [test_windows]
OBSERVER_S = WARM_UP_S / 4  # time constant of the observer that leads a simulation to its start [test_windows]
COMPARED_ROWS = 13  # of a simulation, at most: rows closer together repeat each other [time]
MAX_WINDOWS = 300  # in a fit, evenly spread: more cost time and tell little [causes]
MIN_WINDOWS = 24  # with which a fit can begin [test_bad_input]
MEASURED_WINDOWS = 3000  # on held-out rows, at most [time]
AT_ONCE = 16384  # simulations that are stepped together, which bounds the memory [test_windows]
STEP_LIMIT, MAX_SUBSTEPS = 1.5, 16  # step times the car's settling rate; Runge-Kutta steps a row [test_windows]
WILD = 1e3  # spreads of its channel, as far as a prediction may be off: one that runs away is no NaN [test_windows]
BLOCK_S = 3.0  # errors farther apart in time count as independent [test_recordings, causes]

# Noise and fit
OUTLIER_FACTOR = 4.0  # times what is expected: larger squared errors count as that (Huber 1964) [test_noise]
FAR_SPREADS = 4.0  # the same of a single error in a regression [test_residuals, test_formula]
NOISE_SHARES = (1e-12, 1e-2)  # of a channel's variance: less than any noise, and more [test_noise]
NOISE_RANGE, NOISE_STRIDE = 30.0, 3.0  # of the logarithm of a variance: above its floor, and in a round
SPEED_GROUPS, GROUP_WINDOWS = 10, 6  # groups with one noise response; windows in each, at least [test_noise]
REGIME_BINS = (3, 4)  # of speed and of steering, as clusters of the robust covariance [test_calibration]
NOMINAL_STEP, EFFECT_STEP = 1e-3, 0.02  # of derivatives, in standard deviations and units of an effect
DAMPING = (0.0, 0.03, 0.3, 3.0, 30.0)  # of Levenberg and Marquardt, relative to second derivatives
MAX_ROUNDS, MAX_TRIES = 30, 8  # of linearising anew; of shorter steps, or weighing outliers anew, in each
CONVERGED, NOISE_CONVERGED = 0.3, 1e-2  # of twice the log-likelihood: a round with less is the last
KEPT_PROMISE = 0.5  # of what a quadratic promises: less, and derivatives are too old, or a size wrong [test_selection]
CLEARLY_CLOSER = 20.0  # of twice the log-likelihood, for which another integrator is taken [test_selection]
EXPLAINED_INFLATION = 2.0  # by correlated errors, up to which a model explains the data [test_calibration]

# Starting points of a calibration
SEARCH_ROWS, POLISH_ROWS = 1000, 4000  # with which starts are judged, and the best is polished [time]
SEARCH_LIMITS = 1e-5, 60  # tolerance and evaluations of each start [time]
POLISH_LIMITS = 1e-8, 300  # of the best: 60 lose a car from mid-range, 1e-12 comes no closer [test_paper_steps]
SEARCH_PRIOR, POLISH_ROUNDS = 0.1, 3  # weight of what is known at first; rounds that find it [test_calibration]
DIFFERENCE = 2.0**-26  # of the range, with which derivatives are taken: half of the digits [test_calibration]
AT_BOUND = 1e-6  # of the range: what is closer is on the bound [test_calibration]
WEIGHT_SHOWN = 0.25  # of a coefficient in an undetermined direction, from which on it is listed [test_calibration]

# Recordings and levels
LEAST_PARTS = 3  # laps, or recordings, with which whole ones are left out [test_recordings]
QUARTERS, MAX_PARTS = 4, 8  # parts where there are no laps; laps, or groups of short ones [test_recordings]
LAP_BINS = 32  # of a lap, to see which parts of the drive passed there [test_recordings]
NEARLY_ALL = 0.9  # of simulations that another part passes, or points that two paths of one road share [test_levels]
LIKE_SPREADS = 0.5  # of speed, steering and throttle, within which two simulations are driven alike [test_recordings]
ALIKE_SHARE = 0.5  # of a recording that others must have driven alike, for causes of it alone [test_recordings]
SESSION_PAUSE_H = 8.0  # between recordings of one session, at most: a night is longer [test_levels]
BESIDE, ALIGNED = 0.05, 0.8  # of a path's extent; cosine of directions: paths of one road [test_levels]
PATH_POINTS = 2000  # of a path that are looked at [time]

# Score test and search
SIZE_GRID = (6.0, 1.5, 0.375, 0.094, 0.023)  # units of an effect that are tried, a factor of 4 apart [test_candidates]
BOTH_SIDES = (*SIZE_GRID, *(-size for size in SIZE_GRID))
SIZE_REACH = (0.5, 3.0)  # times a size, for which its response serves: the grid without gaps
NONLINEARITY = 0.1  # relative difference of responses to two sizes, beyond which all sizes are tried
VISIBLE_NOISE_SHARE = 0.3  # of the noise, that a unit of an effect has to change [test_candidates]
COLUMN_LEFT = 1e-5  # of a response that nominal values must leave, for it to be seen at all
BOUND_MARGIN = 0.02  # of the range, that a start stays from its bounds
SHORTLIST, SHORTLIST_WINDOWS = 9, 150  # candidates of which several sizes are tried, and on how many windows [time]
SHORTLIST_SHARE, REFINED = 0.15, 4  # of the best, to be fitted in full; candidates that are, at most [causes]
NEAR_BEST_SHARE = 0.9  # of the best delta BIC, to be fitted to the end [causes]
WARM_STARTS = 3  # times that nominal values make room for an effect before its sizes are judged [test_selection]
SIZE_SHARES = (1.6, 1.0, 0.6, 0.3)  # of what linearised errors promise, that are tried [test_selection]
TRIAL_ROUNDS = 10  # of a fit where no size keeps its promise
MAX_CAUSES = 4  # effects in a diagnosis [causes]

# Evidence
DECISIVE_DELTA_BIC = 10.0  # very strong evidence (Kass and Raftery 1995) [test_selection, causes]
AMBIGUITY_DELTA_BIC = 6.0  # candidates this close are polished before they are compared [causes]
LOOK_SHARE = 0.3  # of the best delta BIC, that another must reach to be tried on left-out parts [causes]
SURE_STD = 3.0  # standard deviations that count as sure: one chance in 370 [test_selection, test_residuals]
BEYOND_STD = 1.0  # more than any car has: a healthy car had 0.9, a planted front_grip of 1.17 1.4 [test_selection]
DOUBTFUL_STD = 2.0  # standard errors, where many were tried or the prior alone decides [test_selection]
WEAK_LOG_RATIO = 3.0  # of likelihoods: no strong evidence yet (Kass and Raftery 1995) [test_selection]
TEMPERING_CHANGE = 0.1  # of the logarithm of the inflation, from which the data are weighed anew
NEAREST_SHARE = 0.125  # of what a cause explains, that may last: right ones leave up to 0.10, others 0.16 [outside]
SMALL_SHARE = 0.06  # of each channel's squared error on left-out parts, below which a cause is small [test_diagnose]
NEGLIGIBLE_SHARE = 0.01  # of an error: too little to count for or against a car [test_diagnose, test_formula]
NOTICEABLE_SHARE = 0.05  # of a channel's error on held-out laps, from which a coefficient is off [test_recalibration]
MOVED_TOGETHER = float(special.chdtri(18, 2.0 * special.ndtr(-SURE_STD)))  # SURE_STD of 18 values [test_diagnose]
NOTED_CHANGE = 0.1  # of an effect's size between two ways to hold inputs, that a note is worth

# What is left
FOLDS, RIDGE = 10, 3.0  # of the regression of errors on signals and place; its penalty [test_residuals]
LAP_STRETCHES = 20  # of a lap, in which errors are averaged [test_residuals]
SHUFFLES, DRAWS = 500, 400  # random orders of errors; bootstrap samples of blocks [time]
CLUSTERED_STD = 5.0  # beyond chance: noise alone reached 2.2 in 15 drives [test_residuals]
CLUSTERED_INFLATION = 4.5  # noise reached 1.1 there, and 3.9 where it was correlated over 0.2 s [test_residuals]
FORMULA_SPAN_S = 0.12  # of a missing acceleration: shorter is noise, longer the car answers [test_outside_the_library]
FORMULA_BESIDE_S = 0.1  # before and after, whose mean are the signals [test_outside_the_library]
FORMULA_DEGREE, FORMULA_TERMS = 3, 3  # signals in a product, products in a formula [test_formula]
CURVE_KNOTS = 8  # of a curve over one signal, which a formula has to beat [test_formula]

# Minimum detectable effects
DETECTION_WINDOWS = 100  # which stand for all [time]
DETECTION_PLACES = (0.0, 0.25, 0.5, 0.75)  # of the lap, at which a local effect is tried [test_minimum_effect]
FIRST_SIZE, SIZE_CHANGE = 0.01, 10.0  # units to begin with: errors are linear there; times in a round, at most
DETECTION_ROUNDS, DETECTION_TOLERANCE = 12, 1.1  # at most; times that a size may be off [test_minimum_effect]
FOLLOW_ROUNDS, FOLLOW_SHARES = 2, (1.0, 0.3)  # in which fitted values follow an effect; shares of a step
