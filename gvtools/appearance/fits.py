"""Several fits to the same photographs, whose pictures are averaged.

A fit is whole after a number of steps that grows with the photographs; more steps then gain next to
nothing. Another fit that makes its random choices anew errs elsewhere, above all where few
photographs leave much open, so that the mean of their pictures is nearer to the truth.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from gvtools.appearance.fit import Fit
from gvtools.appearance.picture import mean_picture

# More fits than this gain nothing that was measured.
MOST_FITS = 6
# Fits go on while the left-out photographs gain this from another one [dB].
LEAST_GAIN = 0.05
# Another fit needs this share of what the first one took.
LEAST_SHARE = 0.5


def run_fits(
    first: Fit,
    *,
    clock: Callable[[], float] = time.perf_counter,
    report: Callable[[Fit, float], object] = lambda fit, share: None,
) -> list[Fit]:
    """Run a fit; if it is whole before its time or its steps are over, run further ones.

    They end when the time or the steps are over, when there are ``MOST_FITS`` of them, or when
    photographs that were left out of them gain nothing more. A fit that goes on with an earlier
    one stays the only one.

    Args:
        first: has not been run.
        clock: tells seconds.
        report: is called now and then with a fit and the share of the whole that is over.

    Returns:
        The fits whose pictures together are best, the first one first.
    """
    options, began = first.options, clock()
    timed = options.seconds is not None
    whole = options.seconds if timed else options.steps_for(len(first.views))
    assert whole is not None
    made, kept = [first], [first]

    def used() -> float:
        return clock() - began if timed else sum(fit.steps for fit in made)

    def tell(share: float) -> None:
        report(made[-1], min(used() / whole, 1.0) if whole else 1.0)

    first.run(clock=clock, report=tell)
    taken = used()
    while len(made) < MOST_FITS and not first.begin:
        left = whole - used()
        if left < LEAST_SHARE * taken or left <= 0:
            break
        box = left / max(round(left / taken), 1)
        more = options.replaced(**({"seconds": box} if timed else {"steps": round(box)}))
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
