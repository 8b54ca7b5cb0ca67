"""Several fits to the same photographs, whose pictures are averaged.

A fit has converged after a number of steps that grows with the number of photographs; more steps
gain next to nothing. Fits with other random seeds make other errors, above all where few
photographs leave much undetermined, so the mean of their pictures is better than each of them.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from gvtools.appearance.fit import Fit, validation_rows
from gvtools.appearance.picture import mean_picture

# A backdrop is another random colour behind the Gaussians at each step, see Fit. With it, an object
# in 12 photographs gains 3 dB, and a toy in 8 loses 0.8 to 2.4. Two trials tell: the first part
# (progress) of fits of so many steps, one with it and one over black.
TRIAL_STEPS, TRIAL_ENDS = 500, 0.2
# There are trials for at most so many photographs, and in fits that may take at least so long [s].
FEW_PHOTOGRAPHS, TRIAL_SECONDS = 16, 15.0
# The fit goes without where photographs that the trials left out are better by more than this [dB].
CLEARLY_BETTER = 0.3
# More fits than this gain nothing measurable.
MOST_FITS = 6
# No further fit is made when the last one raised the PSNR of validation photographs by less [dB].
LEAST_GAIN = 0.05
# A further fit begins only if at least this share of the first one's time, or steps, and of its
# Gaussians is left.
LEAST_SHARE = 0.5


def with_chosen_backdrop(fit: Fit) -> tuple[Fit, str]:
    """A fit that has not begun, or the same over black if left-out photographs say so; and why."""
    few, limit = len(fit.views) <= FEW_PHOTOGRAPHS, fit.options.limit
    long = (fit.options.steps or 0) >= TRIAL_STEPS if limit is None else limit >= TRIAL_SECONDS
    if fit.begin or fit.recorded or not (few and long and validation_rows(len(fit.views))):
        return fit, ""
    options = fit.options.replaced(seconds=None, steps=TRIAL_STEPS)
    trials = [fit.again(0, options, backdrop=backdrop) for backdrop in (True, False)]
    for trial in trials:
        trial.run(until=TRIAL_ENDS)
    random, black = (trial.left_out_psnr() for trial in trials)
    chosen = fit.again(0, fit.options, backdrop=False) if black > random + CLEARLY_BETTER else fit
    behind = "random colours" if chosen is fit else "black"
    return chosen, (
        f"{behind} behind the Gaussians (trials with left-out photographs: random {random:.2f} dB, "
        f"black {black:.2f} dB)"
    )


def run_fits(
    first: Fit,
    *,
    clock: Callable[[], float] = time.perf_counter,
    report: Callable[[Fit, float], object] = lambda fit, share: None,
) -> list[Fit]:
    """Run a fit; if it converges before its time or its steps are over, run further ones.

    No more are made when the time, the steps or the Gaussians that the options allow are used up,
    when there are ``MOST_FITS``, or when the last one raised the PSNR of validation photographs by
    less than ``LEAST_GAIN``. A fit that continues an earlier one (``Fit.begin`` above 0) is run
    alone.

    Args:
        clock: returns seconds.
        report: is called now and then with the fit at work and the share of the whole time, or
            steps, that is over.

    Returns:
        The fits to average, the first one first: a fit that lowered that PSNR is left out.
    """
    options, began = first.options, clock()
    timed = options.limit is not None
    # In seconds, or in steps where these are given.
    budget = options.limit if options.limit is not None else float(options.steps or 0)
    made, kept = [first], [first]

    def used() -> float:
        return clock() - began if timed else sum(fit.steps for fit in made)

    def tell(share: float) -> None:
        report(made[-1], min(used() / budget, 1.0) if budget else 1.0)

    first.run(clock=clock, report=tell)
    taken = used()
    while len(made) < MOST_FITS and not (first.begin or first.stopped):
        left = budget - used()
        if left < LEAST_SHARE * taken or left <= 0:
            break
        room = options.most_gaussians - sum(len(fit.population) for fit in kept)
        if room < max(LEAST_SHARE * len(first.population), len(first.start)):
            break
        # The rest is shared evenly by as many fits as fit into it, by time and by Gaussians.
        fits_left = min(round(left / taken), room // max(len(first.population), len(first.start)))
        part = left / max(fits_left, 1)
        length = {"seconds": part} if timed else {"steps": round(part)}
        more = options.replaced(most_gaussians=room, **length)
        fit = first.again(len(made), more)
        made.append(fit)
        fit.run(clock=clock, report=tell)
        gain = _gain(kept, fit)
        # Without validation photographs, a fit that was stopped early would only blur the others.
        if gain > 0 if gain is not None else not fit.stopped:
            kept.append(fit)
        if gain is not None and gain < LEAST_GAIN:
            break
    report(made[-1], 1.0)
    return kept


def _gain(fits: list[Fit], another: Fit) -> float | None:
    """Gain in PSNR of validation photographs by another fit [dB]; None if there are none."""
    if not another.predicted:
        return None
    before = {row: mean_picture([fit.predicted[row] for fit in fits]) for row in another.predicted}
    after = {
        row: mean_picture([*(fit.predicted[row] for fit in fits), shown])
        for row, shown in another.predicted.items()
    }
    return another.psnr_of(after) - another.psnr_of(before)
