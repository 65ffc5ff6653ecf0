"""Commands that say how accurate an arm is, and for how long."""

from console.options import (
    ARM,
    AS_GIVEN,
    BOARDS,
    FREE_ZERO,
    JSON,
    OUT,
    SOCKET,
    WIRE_AT,
    CommandSpec,
    finite,
    option,
    out_unless,
    payload,
    points,
    scenario,
)

ASSESSING = (
    CommandSpec(
        "verify",
        "compare the calibrated arm with the nominal one at points that calibration did not use",
        (
            ARM,
            SOCKET,
            option("--against A", "the nominal arm (default: the one named in the calibrated arm.toml)"),
            OUT,
            JSON,
            option("--points P", "use recorded poses with measured tips, or lengths; nothing moves"),
            option(
                "--free", "place the frame of the points' tips where each model fits best", choices=("base",)
            ),
            option("--fix", "base: the points' tips are in the arm's base frame", choices=("base",)),
            AS_GIVEN,
            WIRE_AT,
            FREE_ZERO,
            option("--mock", "use a mock of the nominal arm in this process"),
            scenario(default="demo"),
            option(
                "--setups",
                "tilts of the board (default: all three)",
                nargs="+",
                default=("normal", "roll", "pitch"),
                choices=("normal", "roll", "pitch"),
            ),
            option("--repeats K", "visits at each point (default: 3)", type=int, default=3),
            option("--height M", "height above the board in m (default: 0.07)", type=finite, default=0.07),
            option(
                "--path-speed M_S", "speed of the trajectories (default: 0.15)", type=finite, default=0.15
            ),
        ),
        "The arm must be homed and holding. The tip moves above the board with each model, and the camera measures."
        " Exit status 1 if the calibrated arm is significantly worse, or every point was used for the calibration.",
        module="calibration.verify",
    ),
    CommandSpec(
        "check-up",
        "decide from a few poses whether the arm is fine, needs a calibration, or has a joint to inspect",
        (
            ARM,
            option(
                "--points P",
                "points.csv of the calibration: what the arm did before; may be repeated",
                action="append",
                required=True,
            ),
            AS_GIVEN,
            out_unless("--plan-only"),
            option("--poses N", "how many, each from two sides (default: 8)", type=int),
            option("--recorded F", "poses that were recorded already, as points.csv; nothing moves"),
            option("--plan-only", "print the poses and how long they take; nothing moves"),
            option("--mock", "use a mock arm in this process"),
            option("--scenario S", "with --mock: a file or a supplied name (default: demo)"),
            option("--seed N", "with --mock: seed of its hidden errors", type=int),
            SOCKET,
            JSON,
        ),
        "The arm must be homed and holding, and a camera must see the tip; docs/trend.md.",
        module="calibration.check_up",
    ),
    CommandSpec(
        "trend",
        "show what drifts between calibrations, how fast, and when the next one is due",
        (
            ARM,
            option(
                "--history FILE", "the record that `--history` of `calibrate` and `gap` writes", required=True
            ),
            option(
                "--tolerance LENGTH", "largest drift of the tip, e.g. 0.5mm: when the next calibration is due"
            ),
            JSON,
        ),
        "Nothing moves. docs/trend.md.",
        module="calibration.check_up",
    ),
    CommandSpec(
        "trust",
        "predict the tip's error over the workspace, from an arm's points or a design's tolerances",
        (
            ARM,
            points(
                "points.csv or .csv.gz of the real arm; with --design: only their poses, as those of the calibration"
            ),
            AS_GIVEN,
            OUT,
            option("--tolerance LENGTH", "the accuracy that is wanted, e.g. 0.5mm"),
            option(
                "--task FILE",
                "way-points as for `armwright run`: the probability that the path keeps the tolerance; may be repeated",
                action="append",
            ),
            option(
                "--visits P",
                "points.csv of `armwright iso9283`: its pose accuracy and repeatability, predicted beside measured",
                action="append",
            ),
            payload(
                "mass at the tip that the map is made for (default: 0); may be repeated", action="append"
            ),
            BOARDS,
            option("--design A", "arm.toml of an arm to be built, instead of --arm"),
            option("--tolerances T", "with --design: tolerances of the parts; a file, or `right`"),
            option("--arms N", "with --design: how many arms are drawn (default: 2000)", type=int),
            option("--seed N", "with --design: seed of the arms (default: 0)", type=int),
            option("--workers K", "with --design: processes (default: all processors)", type=int),
            option("--cluster ADDRESS", "with --design: a Dask scheduler, e.g. tcp://host:8786"),
            JSON,
        ),
        "Nothing moves. Writes report.html, map.npz and trust.json or tolerances.json; docs/trust.md, docs/tolerances.md.",
        module="calibration.trust",
    ),
    CommandSpec(
        "iso9283",
        "the fourteen performance characteristics of ISO 9283, from recorded data, the arm, or a mock arm",
        (
            ARM,
            option("--points P", "evaluate recorded poses: points.csv with P1 to P5"),
            AS_GIVEN,
            option("--log L", "with --points: recorded runs, log.csv; may be repeated", action="append"),
            option(
                "--other P",
                "points.csv of another arm, for exchangeability; may be repeated",
                action="append",
            ),
            option("--programme FILE", "programme.json of the recording (default: beside the points)"),
            option("--record", "run the test programmes on the connected arm"),
            option("--mock", "run the test programmes on a mock arm in this process"),
            out_unless("--plan-only"),
            JSON,
            SOCKET,
            scenario(default="demo"),
            option("--seed N", "with --mock: seed of the hidden errors", type=int),
            option("--quick", "fewer repeats: 5 of each pose, 3 of each path"),
            option("--repeats N", "visits of each pose (default: 30)", type=int),
            option("--path-cycles N", "runs of each path (default: 10)", type=int),
            option(
                "--speeds SHARE",
                "path speeds as fractions of the rated speed (default: 0.1 0.5 1)",
                type=finite,
                nargs="+",
            ),
            option(
                "--rated-speed M_S",
                "rated path speed (default: the fastest for the test line without slowdown)",
                type=finite,
            ),
            option(
                "--rated-load-kg KG",
                "largest load at the tip for the static compliance (default: none; with --mock 1)",
                type=finite,
            ),
            option("--drift-s S", "duration of the drift test (default: 600)", type=finite),
            option(
                "--programmes NAME",
                "only these: pose directions distance drift path cornering posing load weaving",
                nargs="+",
            ),
            option("--cube-centre X Y Z", "centre of the test cube in m", type=finite, nargs=3),
            option("--cube-edge M", "edge of the test cube (default: the largest within reach)", type=finite),
            option(
                "--speed F",
                "speed of joint moves as a fraction of the joints' limits (default: 0.5; with --mock 1)",
                type=finite,
            ),
            option(
                "--band-m M",
                "limit band of stabilization, overshoot and posing time (default: the repeatability of P1)",
                type=finite,
            ),
            option("--plan-only", "with --record or --mock: check and print the plan"),
        ),
        "Give one of --points, --record and --mock. Writes iso9283.json and iso9283.html. Recording also writes"
        " points.csv, log.csv and programme.json, and resumes after an interruption. docs/iso9283.md describes each"
        " characteristic.",
        module="calibration.iso9283",
    ),
)


PLANNING = (
    CommandSpec(
        "plan-path",
        "plan a path, or stops, for the least expected tip error: place, branch, side of approach, order, speed",
        (
            ARM,
            option("file FILE", "way-points as for `armwright run`"),
            points("points.csv or .csv.gz of the real arm: what is known of its error", is_required=True),
            AS_GIVEN,
            option("--out DIR", "folder for the results; created if missing", required=True),
            option("--stops", "the arm stops at every way-point, and each is approached on its own"),
            option("--any-order", "the way-points may be visited in another order; a path backwards"),
            option(
                "--shift X Y Z",
                "how far the work may be moved along x, y, z of the base frame, either way, in m (default: not at all)",
                type=finite,
                nargs=3,
            ),
            option("--tolerance LENGTH", "e.g. 0.5mm: also say how probably it is kept"),
            payload("mass at the tip (default: 0)"),
            BOARDS,
            JSON,
        ),
        "Nothing moves. Writes path.csv or poses.csv, script.txt and task.json; docs/plan_path.md.",
        module="calibration.planning",
    ),
)
