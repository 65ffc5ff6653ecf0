"""Commands that make of measurements a better arm, and say how good it is."""

from console.options import ARM, JSON, OUT, SOCKET, CommandSpec, finite, option

CALIBRATING = (
    CommandSpec(
        "calibrate",
        "identify the arm's parameters from recorded points, and say what the result is worth",
        (
            ARM,
            option(
                "--points",
                metavar="P",
                action="append",
                required=True,
                help="points.csv or .csv.gz; may be given several times",
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
                help="distance from which huber counts linearly, e.g. 0.3mm (default: from the noise)",
            ),
            option(
                "--bound",
                metavar="NAME=VALUE",
                action="append",
                help="largest deviation: lengths=5mm, angles=2deg (these are the defaults), or one parameter, e.g. L2=8mm",
            ),
            option(
                "--fix",
                metavar="NAMES",
                action="append",
                help="parameters that keep their value: theta4,tool_x; base: the tips are in the arm's own base frame",
            ),
            option(
                "--free",
                metavar="FRAMES",
                action="append",
                help="frames that are identified too: base, table, tool (boards and trackers of unknown place always are)",
            ),
            option(
                "--effect",
                metavar="EFFECT",
                action="append",
                help="a static effect that is identified too: backlash:2, joint_compliance:2, encoder_scale:1, belt_coupling",
            ),
            option(
                "--boards", metavar="FILE", help="boards.json of `armwright register`: where the boards stood"
            ),
            option(
                "--accuracy",
                metavar="LENGTH",
                help="the mean distance that is wanted (a in E <= k a); said if it cannot be met",
            ),
            option(
                "--without",
                metavar="POSE",
                action="append",
                help="leave out SETUP, SETUP:POINT or SETUP:POINT:REPEAT; may be given several times",
            ),
            option(
                "--leave-out",
                metavar="WHAT",
                help="for the held-out error: setups, or k for every k-th point (default: setups where there are several)",
            ),
            option("--export", metavar="FORMS", action="append", help="urdf, mjcf, json: for other tools"),
            option(
                "--starts", type=int, default=4, metavar="N", help="searches from other places (default: 4)"
            ),
            option(
                "--seed", type=int, default=0, metavar="N", help="of the places where they start (default: 0)"
            ),
            JSON,
        ),
        "Writes arm.toml, calibration.json and report.html to the folder; nothing is overwritten.",
        module="calibration.calibrate",
    ),
    CommandSpec(
        "verify",
        "whether a calibrated arm is better than the nominal one, where calibration has never been",
        (
            ARM,
            SOCKET,
            option(
                "--against",
                metavar="A",
                help="the nominal arm (default: what the calibrated one says it comes from)",
            ),
            OUT,
            JSON,
            option("--points", metavar="FILE", help="recorded poses with measured tips; then nothing moves"),
            option("--mock", action="store_true", help="on a stepped mock of the nominal arm"),
            option(
                "--scenario",
                default="demo",
                metavar="S",
                help="of --mock: a scenario file or the name of one that ships",
            ),
            option(
                "--setups",
                nargs="+",
                default=("normal", "roll", "pitch"),
                choices=("normal", "roll", "pitch"),
                help="tilts of the board to go above (default: all three)",
            ),
            option("--repeats", type=int, default=3, metavar="K", help="visits at each point (default: 3)"),
            option(
                "--height",
                type=finite,
                default=0.07,
                metavar="M",
                help="above the board, in m (default: 0.07)",
            ),
            option(
                "--path-speed",
                type=finite,
                default=0.15,
                metavar="M_S",
                help="of the trajectories (default: 0.15)",
            ),
        ),
        "The arm must be homed and hold; the tip goes above the board by either model and the camera measures. Exit status 1"
        " where the calibrated arm is worse by more than chance.",
        module="calibration.verify",
    ),
    CommandSpec(
        "gap",
        "name the effect that the model lacks, add it, and show the gap close; or say that the data cannot tell",
        (
            ARM,
            option(
                "--points",
                metavar="P",
                action="append",
                help="static poses, points.csv or .csv.gz; may be given several times",
            ),
            option(
                "--log",
                metavar="L",
                action="append",
                help="time series, log.csv or .csv.gz; may be given several times",
            ),
            OUT,
            option(
                "--without",
                metavar="EFFECT",
                action="append",
                help="leave an effect out of the list of those that are tried",
            ),
            JSON,
            option(
                "--record",
                action="store_true",
                help="plan and record poses and motions first; the same --out goes on after an interruption",
            ),
            option("--mock", action="store_true", help="with --record: on a mock arm in this process"),
            option(
                "--scenario", metavar="S", help="what the mock arm hides: a file or a name (default: demo)"
            ),
            option("--seed", type=int, metavar="N", help="of what the mock arm hides"),
            option("--quick", action="store_true", help="with --record: fewer poses, shorter motions"),
            option("--minutes", type=finite, metavar="M", help="with --record: as much as fits into so long"),
            option(
                "--payload",
                type=finite,
                metavar="KG",
                help="a mass that is hung at the tip for part of the recording (default: none; mock: 0.5)",
            ),
            option("--only", choices=("static", "motion"), help="with --record: poses only, or motions only"),
            option(
                "--plan-only",
                action="store_true",
                help="with --record: say what would be recorded and what it would make nameable; nothing moves",
            ),
            option("--record-only", action="store_true", help="with --record: do not look at it yet"),
            SOCKET,
        ),
        "Writes gap.json, arm.toml with what was named, and report.html to the folder; nothing is overwritten."
        " `armwright gap --points points.csv --log log.csv --out out/gap` looks at files;"
        " `armwright gap --record --plan-only --out out/gap` says what it would record;"
        " `armwright gap --record --mock --quick --out out/gap` tries it on a mock arm.",
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
            option("--mock", action="store_true", help="run them on a mock arm in this process"),
            OUT,
            JSON,
            SOCKET,
            option(
                "--scenario",
                default="demo",
                metavar="S",
                help="with --mock: a scenario file or the name of one that ships (default: demo)",
            ),
            option("--seed", type=int, help="with --mock: seed of what is hidden in it"),
            option("--quick", action="store_true", help="fewer repeats: 5 of each pose, 3 of each path"),
            option("--repeats", type=int, metavar="N", help="visits of each pose (default: 30)"),
            option("--path-cycles", type=int, metavar="N", help="runs of each path (default: 10)"),
            option(
                "--speeds",
                type=finite,
                nargs="+",
                metavar="SHARE",
                help="path speeds as shares of the rated one (default: 0.1 0.5 1)",
            ),
            option(
                "--rated-speed",
                type=finite,
                metavar="M_S",
                help="rated path speed (default: the fastest that the planner need not slow on the test line)",
            ),
            option(
                "--rated-load-kg",
                type=finite,
                metavar="KG",
                help="loads up to this hang at the tip for the static compliance (default: none; with --mock 1)",
            ),
            option("--drift-s", type=finite, metavar="S", help="how long drift is watched (default: 600)"),
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
                help="its edge (default: the largest cube within reach)",
            ),
            option(
                "--speed",
                type=finite,
                metavar="F",
                help="of joint moves, a fraction of the joints' limits (default: 0.5; with --mock 1)",
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
                help="with --record or --mock: check and say what would be done",
            ),
        ),
        "Give one of --points, --record and --mock. Writes iso9283.json and iso9283.html; recording adds points.csv,"
        " log.csv and programme.json, line by line, and goes on where it was interrupted. docs/iso9283.md says what each"
        " criterion takes.",
        module="calibration.iso9283",
    ),
)
