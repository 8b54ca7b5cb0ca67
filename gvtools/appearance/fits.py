"""Several fits to the same photographs, whose pictures are averaged.

A fit has converged after a number of steps that grows with the number of photographs; more steps
gain next to nothing. Further fits with other random choices make other errors, above all where few
photographs leave much open, so the mean of their pictures is nearer to the truth than each.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from gvtools.appearance.fit import Fit
from gvtools.appearance.picture import mean_picture

# More fits than this gain nothing that was measured.
MOST_FITS = 6
# No further fit is made when the last one raised the PSNR of left-out photographs by less [dB].
LEAST_GAIN = 0.05
# No further fit begins with less left than this share of the time, or steps, that the first took.
LEAST_SHARE = 0.5


def run_fits(
    first: Fit,
    *,
    clock: Callable[[], float] = time.perf_counter,
    report: Callable[[Fit, float], object] = lambda fit, share: None,
) -> list[Fit]:
    """Run a fit; if it converges before its time or its steps are over, run further ones.

    There are no more when the time or the steps are over, when there are ``MOST_FITS``, or when
    photographs that were left out of the fits gain less than ``LEAST_GAIN`` by the last one. None
    come after a fit that continues an earlier one (``Fit.begin`` above 0).

    Args:
        first: has not been run.
        clock: tells seconds.
        report: is called now and then with a fit and the share of the whole that is over.

    Returns:
        The fits whose pictures together are best, the first one first.
    """
    options, began = first.options, clock()
    timed = options.seconds is not None
    # In seconds where a time is given, else in steps.
    budget = options.seconds if timed else options.steps_for(len(first.views))
    assert budget is not None
    made, kept = [first], [first]

    def used() -> float:
        return clock() - began if timed else sum(fit.steps for fit in made)

    def tell(share: float) -> None:
        report(made[-1], min(used() / budget, 1.0) if budget else 1.0)

    first.run(clock=clock, report=tell)
    taken = used()
    while len(made) < MOST_FITS and not first.begin:
        left = budget - used()
        if left < LEAST_SHARE * taken or left <= 0:
            break
        # What is left is shared evenly by the fits that find room in it.
        part = left / max(round(left / taken), 1)
        more = options.replaced(**({"seconds": part} if timed else {"steps": round(part)}))
        fit = first.again(len(made), more)
        made.append(fit)
        fit.run(clock=clock, report=tell)
        gain = _gain(kept, fit)
        if gain is None or gain > 0:
            kept.append(fit)
        if gain is not None and gain < LEAST_GAIN:
            break
    report(made[-1], 1.0)
    return kept


def _gain(fits: list[Fit], another: Fit) -> float | None:
    """What left-out photographs gain from another fit [dB]; None where none was left out."""
    if not another.judged:
        return None
    before = {row: mean_picture([fit.judged[row] for fit in fits]) for row in another.judged}
    after = {
        row: mean_picture([*(fit.judged[row] for fit in fits), shown])
        for row, shown in another.judged.items()
    }
    return another.judge(after) - another.judge(before)
