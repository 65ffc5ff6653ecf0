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
            option(
                "--against",
                metavar="A",
                help="the nominal arm (default: the one named in the calibrated arm.toml)",
            ),
            OUT,
            JSON,
            option(
                "--points",
                metavar="P",
                help="use recorded poses with measured tips, or lengths; nothing moves",
            ),
            option(
                "--free",
                choices=("base",),
                help="place the frame of the points' tips where each model fits best",
            ),
            option("--fix", choices=("base",), help="base: the points' tips are in the arm's base frame"),
            AS_GIVEN,
            WIRE_AT,
            FREE_ZERO,
            option("--mock", action="store_true", help="use a mock of the nominal arm in this process"),
            scenario(default="demo"),
            option(
                "--setups",
                nargs="+",
                default=("normal", "roll", "pitch"),
                choices=("normal", "roll", "pitch"),
                help="tilts of the board (default: all three)",
            ),
            option("--repeats", type=int, default=3, metavar="K", help="visits at each point (default: 3)"),
            option(
                "--height",
                type=finite,
                default=0.07,
                metavar="M",
                help="height above the board in m (default: 0.07)",
            ),
            option(
                "--path-speed",
                type=finite,
                default=0.15,
                metavar="M_S",
                help="speed of the trajectories (default: 0.15)",
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
                "--points",
                metavar="P",
                action="append",
                required=True,
                help="points.csv of the calibration: what the arm did before; may be repeated",
            ),
            AS_GIVEN,
            out_unless("--plan-only"),
            option("--poses", type=int, metavar="N", help="how many, each from two sides (default: 8)"),
            option(
                "--recorded",
                metavar="F",
                help="poses that were recorded already, as points.csv; nothing moves",
            ),
            option(
                "--plan-only",
                action="store_true",
                help="print the poses and how long they take; nothing moves",
            ),
            option("--mock", action="store_true", help="use a mock arm in this process"),
            option("--scenario", metavar="S", help="with --mock: a file or a supplied name (default: demo)"),
            option("--seed", type=int, metavar="N", help="with --mock: seed of its hidden errors"),
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
                "--history",
                metavar="FILE",
                required=True,
                help="the record that `--history` of `calibrate` and `gap` writes",
            ),
            option(
                "--tolerance",
                metavar="LENGTH",
                help="largest drift of the tip, e.g. 0.5mm: when the next calibration is due",
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
            option("--tolerance", metavar="LENGTH", help="the accuracy that is wanted, e.g. 0.5mm"),
            option(
                "--task",
                metavar="FILE",
                action="append",
                help="way-points as for `armwright run`: the probability that the path keeps the tolerance; may be repeated",
            ),
            option(
                "--visits",
                metavar="P",
                action="append",
                help="points.csv of `armwright iso9283`: its pose accuracy and repeatability, predicted beside measured",
            ),
            payload(
                "mass at the tip that the map is made for (default: 0); may be repeated", action="append"
            ),
            BOARDS,
            option("--design", metavar="A", help="arm.toml of an arm to be built, instead of --arm"),
            option(
                "--tolerances",
                metavar="T",
                help="with --design: tolerances of the parts; a file, or `right`",
            ),
            option(
                "--arms", type=int, metavar="N", help="with --design: how many arms are drawn (default: 2000)"
            ),
            option("--seed", type=int, metavar="N", help="with --design: seed of the arms (default: 0)"),
            option(
                "--workers", type=int, metavar="K", help="with --design: processes (default: all processors)"
            ),
            option(
                "--cluster", metavar="ADDRESS", help="with --design: a Dask scheduler, e.g. tcp://host:8786"
            ),
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
            option("--points", metavar="P", help="evaluate recorded poses: points.csv with P1 to P5"),
            AS_GIVEN,
            option(
                "--log",
                metavar="L",
                action="append",
                help="with --points: recorded runs, log.csv; may be repeated",
            ),
            option(
                "--other",
                metavar="P",
                action="append",
                help="points.csv of another arm, for exchangeability; may be repeated",
            ),
            option(
                "--programme",
                metavar="FILE",
                help="programme.json of the recording (default: beside the points)",
            ),
            option("--record", action="store_true", help="run the test programmes on the connected arm"),
            option(
                "--mock", action="store_true", help="run the test programmes on a mock arm in this process"
            ),
            out_unless("--plan-only"),
            JSON,
            SOCKET,
            scenario(default="demo"),
            option("--seed", type=int, metavar="N", help="with --mock: seed of the hidden errors"),
            option("--quick", action="store_true", help="fewer repeats: 5 of each pose, 3 of each path"),
            option("--repeats", type=int, metavar="N", help="visits of each pose (default: 30)"),
            option("--path-cycles", type=int, metavar="N", help="runs of each path (default: 10)"),
            option(
                "--speeds",
                type=finite,
                nargs="+",
                metavar="SHARE",
                help="path speeds as fractions of the rated speed (default: 0.1 0.5 1)",
            ),
            option(
                "--rated-speed",
                type=finite,
                metavar="M_S",
                help="rated path speed (default: the fastest for the test line without slowdown)",
            ),
            option(
                "--rated-load-kg",
                type=finite,
                metavar="KG",
                help="largest load at the tip for the static compliance (default: none; with --mock 1)",
            ),
            option("--drift-s", type=finite, metavar="S", help="duration of the drift test (default: 600)"),
            option(
                "--programmes",
                nargs="+",
                metavar="NAME",
                help="only these: pose directions distance drift path cornering posing load weaving",
            ),
            option(
                "--cube-centre",
                type=finite,
                nargs=3,
                metavar=("X", "Y", "Z"),
                help="centre of the test cube in m",
            ),
            option(
                "--cube-edge",
                type=finite,
                metavar="M",
                help="edge of the test cube (default: the largest within reach)",
            ),
            option(
                "--speed",
                type=finite,
                metavar="F",
                help="speed of joint moves as a fraction of the joints' limits (default: 0.5; with --mock 1)",
            ),
            option(
                "--band-m",
                type=finite,
                metavar="M",
                help="limit band of stabilization, overshoot and posing time (default: the repeatability of P1)",
            ),
            option(
                "--plan-only",
                action="store_true",
                help="with --record or --mock: check and print the plan",
            ),
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
            option("file", metavar="FILE", help="way-points as for `armwright run`"),
            points("points.csv or .csv.gz of the real arm: what is known of its error", is_required=True),
            AS_GIVEN,
            option("--out", metavar="DIR", required=True, help="folder for the results; created if missing"),
            option(
                "--stops",
                action="store_true",
                help="the arm stops at every way-point, and each is approached on its own",
            ),
            option(
                "--any-order",
                action="store_true",
                help="the way-points may be visited in another order; a path backwards",
            ),
            option(
                "--shift",
                type=finite,
                nargs=3,
                metavar=("X", "Y", "Z"),
                help="how far the work may be moved along x, y, z of the base frame, either way, in m (default: not at all)",
            ),
            option("--tolerance", metavar="LENGTH", help="e.g. 0.5mm: also say how probably it is kept"),
            payload("mass at the tip (default: 0)"),
            BOARDS,
            JSON,
        ),
        "Nothing moves. Writes path.csv or poses.csv, script.txt and task.json; docs/plan_path.md.",
        module="calibration.planning",
    ),
)
