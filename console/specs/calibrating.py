"""Commands that calibrate and verify an arm from measurements."""

from console.options import ARM, JSON, OUT, SOCKET, CommandSpec, finite, option

CALIBRATING = (
    CommandSpec(
        "calibrate",
        "identify the arm's parameters from recorded points, with their uncertainty",
        (
            ARM,
            option(
                "--points",
                metavar="P",
                action="append",
                required=True,
                help="points.csv or .csv.gz; may be repeated",
            ),
            OUT,
            option(
                "--objective",
                default="e2",
                metavar="NAME",
                help="e2: sum of distances, the paper's (default); e1: sum of absolute coordinates; lsq: least squares; huber",
            ),
            option(
                "--huber-threshold",
                metavar="LENGTH",
                help="distance above which huber is linear, e.g. 0.3mm (default: from the noise)",
            ),
            option(
                "--bound",
                metavar="NAME=VALUE",
                action="append",
                help="largest deviation: lengths=5mm, angles=2deg (the defaults), or one parameter, e.g. L2=8mm",
            ),
            option(
                "--fix",
                metavar="NAMES",
                action="append",
                help="parameters to keep fixed: theta4,tool_x; base: the tips are in the arm's base frame; target: the axes of"
                " measured orientations are the last link's",
            ),
            option(
                "--orientation-noise",
                metavar="ANGLE",
                help="standard deviation of measured orientations, e.g. 0.5mrad (default: arm.toml's [camera], else 2mrad)",
            ),
            option(
                "--free",
                metavar="FRAMES",
                action="append",
                help="frames to identify too: base, table, tool (boards and trackers of unknown place always are)",
            ),
            option(
                "--effect",
                metavar="EFFECT",
                action="append",
                help="static effects to identify too: backlash:2, joint_compliance:2, encoder_scale:1, belt_coupling",
            ),
            option(
                "--boards", metavar="FILE", help="boards.json of `armwright register`: measured board poses"
            ),
            option(
                "--accuracy",
                metavar="LENGTH",
                help="required mean error (a in E <= k a); warns if it cannot be met",
            ),
            option(
                "--without",
                metavar="POSE",
                action="append",
                help="omit SETUP, SETUP:POINT or SETUP:POINT:REPEAT; may be repeated",
            ),
            option(
                "--leave-out",
                metavar="WHAT",
                help="held-out part: setups, or k for every k-th point (default: setups if there are several)",
            ),
            option("--export", metavar="FORMS", action="append", help="also write urdf, mjcf or json"),
            option("--starts", type=int, default=4, metavar="N", help="number of random starts (default: 4)"),
            option("--seed", type=int, default=0, metavar="N", help="seed of the random starts (default: 0)"),
            JSON,
        ),
        "Writes arm.toml, calibration.json and report.html; never overwrites.",
        module="calibration.calibrate",
    ),
    CommandSpec(
        "trust",
        "predict the tip's error over the workspace, with intervals, and whether a path keeps a tolerance",
        (
            ARM,
            option(
                "--points",
                metavar="P",
                action="append",
                required=True,
                help="points.csv or .csv.gz of the real arm; may be repeated",
            ),
            OUT,
            option("--tolerance", metavar="LENGTH", help="the accuracy that is wanted, e.g. 0.5mm"),
            option(
                "--task",
                metavar="FILE",
                action="append",
                help="way-points as for `armwright run`: the probability that the path keeps the tolerance; may be repeated",
            ),
            option(
                "--payload",
                type=finite,
                metavar="KG",
                action="append",
                help="mass at the tip that the map is made for (default: 0); may be repeated",
            ),
            option(
                "--boards", metavar="FILE", help="boards.json of `armwright register`: measured board poses"
            ),
            JSON,
        ),
        "Nothing moves. Writes report.html, map.npz and trust.json; docs/trust.md.",
        module="calibration.trust",
    ),
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
            option("--points", metavar="FILE", help="use recorded poses with measured tips; nothing moves"),
            option("--mock", action="store_true", help="use a stepped mock of the nominal arm"),
            option(
                "--scenario",
                default="demo",
                metavar="S",
                help="with --mock: a scenario file or a shipped name",
            ),
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
                help="heights above the board in m (default: 0.07)",
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
        " Exit status 1 if the calibrated arm is significantly worse.",
        module="calibration.verify",
    ),
    CommandSpec(
        "gap",
        "name the effects that the model lacks, add them, and show how far the gap closes",
        (
            ARM,
            option(
                "--points",
                metavar="P",
                action="append",
                help="static poses, points.csv or .csv.gz; may be repeated",
            ),
            option(
                "--log",
                metavar="L",
                action="append",
                help="time series, log.csv or .csv.gz; may be repeated",
            ),
            OUT,
            option(
                "--without",
                metavar="EFFECT",
                action="append",
                help="do not try this effect; may be repeated",
            ),
            option(
                "--map",
                action="store_true",
                help="measure what is left as maps of the joints, which the controller corrects",
            ),
            option(
                "--current-unit",
                default="A",
                choices=("A", "mA", "percent", "Nm", "motor_Nm"),
                help="what the columns i1_A ... hold: currents, percent of the drives' limits, torques of joints or motors",
            ),
            JSON,
            option(
                "--record",
                action="store_true",
                help="plan and record poses and motions first; the same --out resumes",
            ),
            option("--mock", action="store_true", help="with --record: use a mock arm in this process"),
            option(
                "--scenario", metavar="S", help="scenario of the mock arm: a file or a name (default: demo)"
            ),
            option("--seed", type=int, metavar="N", help="seed of the mock arm's hidden errors"),
            option("--quick", action="store_true", help="with --record: fewer poses, shorter motions"),
            option("--minutes", type=finite, metavar="M", help="with --record: as much as fits in this time"),
            option(
                "--payload",
                type=finite,
                metavar="KG",
                help="mass attached to the tip for part of the recording (default: none; mock: 0.5)",
            ),
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
        " --points points.csv --log log.csv --out out/gap` analyses files. `armwright gap --record --plan-only --out"
        " out/gap` prints the plan. `armwright gap --record --mock --quick --out out/gap` tries it on a mock arm.",
        module="calibration.gap",
    ),
    CommandSpec(
        "iso9283",
        "the fourteen performance criteria of ISO 9283 from recorded data, the arm, or a mock arm",
        (
            ARM,
            option("--points", metavar="P", help="evaluate recorded poses: points.csv with P1 to P5"),
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
            OUT,
            JSON,
            SOCKET,
            option(
                "--scenario",
                default="demo",
                metavar="S",
                help="with --mock: a scenario file or a shipped name (default: demo)",
            ),
            option("--seed", type=int, help="with --mock: seed of the hidden errors"),
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
        " criterion.",
        module="calibration.iso9283",
    ),
)
