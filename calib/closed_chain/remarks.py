"""What a reader of a pair's calibration must know: whether it explains the contacts, which the others contradict, bounds."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from calib.closed_chain.calibrate import PairFound

EXPLAINED = 0.5  # of the error of contacts left out: a calibration that leaves more has not understood them
CONTRADICTED = 6.0  # times the median error of contacts left out
LEAST_m = 5e-4  # below it a contact is as good as hands and backlash allow
NAMED = 6  # contacts, and parameters
SPARE = 1.5  # rows of three numbers over the numbers that they determine


def remarks(found: PairFound) -> Iterator[str]:
    """Sentences, the gravest first; none for a result without reproach."""
    before, after = found.held_before_m, found.held_after_m
    is_enough = found.numbers_count >= SPARE * found.known.rank
    if len(after):
        left_m, nominal_m = float(np.median(after)), float(np.median(before))  # some contacts may be none
        if left_m > max(EXPLAINED * nominal_m, LEAST_m):
            yield (
                f"This does not explain the contacts: left out, half of them stay open by {1e3 * left_m:.2f} mm or more, with"
                f" nominal arms by {1e3 * nominal_m:.2f} mm. Check distance_m (in m), the order of the joints, and that both tips"
                " touched"
            )
        wrong = np.flatnonzero(after > max(CONTRADICTED * float(np.median(after)), LEAST_m))
        if len(wrong) and is_enough:
            worst = wrong[np.argsort(-after[wrong])]
            named = [f"{found.names[row]} ({1e3 * after[row]:.2f} mm)" for row in worst[:NAMED]]
            more = f" and {len(wrong) - NAMED} more" if len(wrong) > NAMED else ""
            yield f"Contradicted by the others: {', '.join(named)}{more}. Look at them; remove what was not a contact"
    at_bound = [one.parameter.name for one in found.estimates if one.is_at_bound]
    if at_bound:
        more = f" and {len(at_bound) - NAMED} more" if len(at_bound) > NAMED else ""
        yield (
            f"At their bounds: {', '.join(at_bound[:NAMED])}{more}. If parts may be that far off, give a larger --bound;"
            " else look for a wrong contact"
        )
    if not is_enough:
        yield (
            f"{found.numbers_count} numbers determine {found.known.rank} parameters: the errors at the contacts of the fit say"
            " nothing, and more contacts are needed"
        )
