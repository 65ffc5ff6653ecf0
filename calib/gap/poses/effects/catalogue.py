"""Every effect that poses can show."""

from __future__ import annotations

from calib.gap.poses.effects import beam, encoder, frame, gear, loads
from calib.gap.poses.effects.scene import Scene
from calib.gap.posterior.term import Term

RECORDS = (*encoder.RECORDS, *gear.RECORDS, *beam.RECORDS, *frame.RECORDS, *loads.RECORDS)
LISTED = tuple(record.effect for record in RECORDS)


def terms_of(scene: Scene) -> tuple[Term, ...]:
    """Every effect on every joint or link, in every variant, that these data could show."""
    return tuple(term for record in RECORDS for term in record.terms(record, scene))
