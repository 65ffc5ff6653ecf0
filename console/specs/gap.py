"""The command that names the effects that the model lacks."""

from console.options import (
    ARM,
    AS_GIVEN,
    JSON,
    SOCKET,
    CommandSpec,
    finite,
    option,
    out_unless,
    payload,
    points,
    scenario,
)
from console.specs.calibrating import HISTORY

GAP = (
    CommandSpec(
        "gap",
        "name the effects that the model lacks, add them, and show how far the gap closes",
        (
            ARM,
            points("static poses, points.csv or .csv.gz"),
            AS_GIVEN,
            option(
                "--log",
                metavar="L",
                action="append",
                help="time series, log.csv or .csv.gz; may be repeated",
            ),
            out_unless("--plan-only"),
            option(
                "--without",
                metavar="EFFECT",
                action="append",
                help="do not try this effect; may be repeated",
            ),
            option(
                "--map",
                action="store_true",
                help="measure the residual as maps of the joints, which the controller corrects",
            ),
            option(
                "--current-unit",
                default="A",
                choices=("A", "mA", "percent", "Nm", "motor_Nm"),
                help="what the columns i1_A ... hold: currents, percent of the drives' limits, torques of joints or motors",
            ),
            *HISTORY,
            JSON,
            option(
                "--record",
                action="store_true",
                help="plan and record poses and motions first; the same --out resumes",
            ),
            option("--mock", action="store_true", help="with --record: use a mock arm in this process"),
            scenario(),
            option("--seed", type=int, metavar="N", help="seed of the mock arm's hidden errors"),
            option("--quick", action="store_true", help="with --record: fewer poses, shorter motions"),
            option("--minutes", type=finite, metavar="M", help="with --record: as much as fits in this time"),
            payload("mass attached to the tip for part of the recording (default: none; mock: 0.5)"),
            option("--only", choices=("static", "motion"), help="with --record: poses only, or motions only"),
            option(
                "--plan-only",
                action="store_true",
                help="with --record: print the plan and the effects that it can reveal; nothing moves",
            ),
            option("--record-only", action="store_true", help="with --record: do not analyse yet"),
            SOCKET,
        ),
        "Writes gap.json, an arm.toml with the named effects, and report.html; never overwrites. `armwright gap"
        " --points points.csv --log log.csv --out out/gap` analyses files. `armwright gap --record --plan-only`"
        " prints the plan. `armwright gap --record --mock --quick --out out/gap` tries it on a mock arm.",
        module="calibration.gap",
    ),
)
