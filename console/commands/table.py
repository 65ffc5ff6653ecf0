"""Every subcommand, in the order of `armwright --help`."""

from console.options import ARM, JSON, LINKS, OUT, RATE, SOCKET, CommandSpec, option

COMMANDS = (
    CommandSpec(
        "demo",
        "the whole job on a mock arm: home, move, record the table, calibrate, verify, report",
        (
            option(
                "what",
                nargs="?",
                choices=("job", "paper"),
                default="job",
                help="the whole job (default), or the paper's experiment beside its published figures",
            ),
            option(
                "--out",
                metavar="DIR",
                help="where the results go (default: out/demo, or out/demo-paper)",
            ),
            option(
                "--realtime",
                action="store_true",
                help="the same in real time: own processes, pty and UDP multicast",
            ),
            option(
                "--seed",
                type=int,
                help="seed of what is hidden in the mock arm (default: the scenario's own)",
            ),
            option(
                "--scenario",
                metavar="S",
                help="a scenario file or the name of one that ships (default: demo, or paper)",
            ),
            ARM,
        ),
        "Nothing is connected and nothing real moves.",
    ),
    CommandSpec(
        "serve",
        "run the arm: connect its boards and serve the local socket until told to stop",
        (
            ARM,
            *LINKS,
            RATE,
            SOCKET,
            option("--log", metavar="DIR", default="log", help="where recordings go (default: log)"),
        ),
        "Drives stay off until `armwright enable`. Ctrl-C stops the arm, holds it, lowers it on shorted windings and ends.",
    ),
    CommandSpec(
        "mock",
        "a mock arm in real time, for `armwright serve` to connect to",
        (
            ARM,
            option(
                "--scenario",
                default="demo",
                metavar="S",
                help="a scenario file or the name of one that ships",
            ),
        ),
        "Prints the command that connects to it.",
    ),
    CommandSpec(
        "check",
        "find the boards that arm.toml names and compare their identities; nothing moves",
        (ARM, *LINKS),
    ),
    CommandSpec("status", "what the arm does now, and what is wrong", (ARM, SOCKET, JSON)),
    CommandSpec("enable", "drives on, holding where the arm stands", (ARM, SOCKET)),
    CommandSpec("home", "find every joint's zero", (ARM, SOCKET)),
    CommandSpec(
        "move",
        "move to joint angles or to a tip position",
        (
            ARM,
            SOCKET,
            option("--joints", type=float, nargs="+", metavar="RAD", help="joint angles in rad"),
            option(
                "--tip",
                type=float,
                nargs=3,
                metavar=("X", "Y", "Z"),
                help="tip position in the base frame in m",
            ),
            option(
                "--speed",
                type=float,
                default=0.5,
                metavar="F",
                help="fraction of the joints' limits (default: 0.5)",
            ),
        ),
        "Give one of --joints and --tip.",
    ),
    CommandSpec(
        "run",
        "run a file of way-points through a Cartesian spline",
        (
            ARM,
            SOCKET,
            option("file", metavar="FILE", help="CSV with x_m,y_m,z_m and, if wanted, speed_m_s"),
            option("--speed", type=float, metavar="M_S", help="one speed for all way-points, in m/s"),
            option(
                "--plan-only", action="store_true", help="check and say what would be done; needs no runtime"
            ),
        ),
        "Everything is checked before anything moves: reach, joint limits, speed, acceleration, table.",
    ),
    CommandSpec("stop", "controlled stop, then hold", (ARM, SOCKET)),
    CommandSpec("guide", "drives off, to guide the arm by hand: somebody must hold it", (ARM, SOCKET)),
    CommandSpec("hold", "end hand-guiding and hold", (ARM, SOCKET)),
    CommandSpec("acknowledge", "a human has seen the fault", (ARM, SOCKET)),
    CommandSpec(
        "off",
        "stop, hold, lower on shorted windings, drives off",
        (ARM, SOCKET, option("--quit", action="store_true", help="end the runtime too")),
    ),
    CommandSpec(
        "session",
        "step through the table's points, seat the tip, record: resumable at any time",
        (
            ARM,
            OUT,
            option(
                "--setups", metavar="S,...", help="tilts of the board, in order (default: those of the table)"
            ),
            option("--points", metavar="P,...", help="cavities by name: 1,2,5-9 (default: all)"),
            option("--repeats", type=int, metavar="N", help="rounds of every point (default: 1)"),
            option(
                "--approaches",
                type=int,
                choices=(1, 2),
                help="from how many sides a point is approached in every round (default: 1)",
            ),
            option(
                "--free",
                metavar="N|FILE",
                help="so many free poses, or those of a file with q1_rad ...; needs --camera",
            ),
            option(
                "--plan",
                metavar="FILE",
                help="the points to take, from `armwright plan-poses`: setup,point and for setup free q1_rad ...",
            ),
            option("--payload", type=float, metavar="KG", help="mass at the tip (default: 0)"),
            option(
                "--seat",
                choices=("hand", "jog"),
                help="the tip is guided by hand with the drives off, or jogged (default: hand)",
            ),
            option(
                "--board",
                choices=("known", "measured", "unknown"),
                help="where the board stands: as the file says, seen by the camera, or unknown (default: as the file says)",
            ),
            option("--camera", action="store_true", default=None, help="record the tip that the camera sees"),
            option("--mock", action="store_true", help="with a stepped mock arm, whose hand seats the tip"),
            option("--scenario", metavar="S", help="of the mock arm: a file or a name (default: demo)"),
            option(
                "--replay", metavar="SCRIPT", help="answers from a file, one a line, in place of the terminal"
            ),
            SOCKET,
        ),
        "Each record is on disk before it is acknowledged. The same command resumes; docs/session.md.",
    ),
    CommandSpec(
        "register",
        "where the calibration board stands, from three or more markers that a camera saw",
        (
            ARM,
            option(
                "--markers",
                required=True,
                metavar="M",
                help="a markers.csv: setup,marker,x_m,y_m,z_m in the base frame; markers are cavities by name",
            ),
            OUT,
        ),
        "Prints the residual of every marker, names those that disagree, writes boards.json.",
    ),
    CommandSpec(
        "plan-poses",
        "which points, tilts and free poses to take next, and how much each would bring",
        (
            ARM,
            option("--points", metavar="P", help="a points.csv with what is taken already"),
            option(
                "--boards",
                metavar="B",
                help="a boards.json of `armwright register`: where the board stands in its setups",
            ),
            option("--count", type=int, metavar="N", help="poses to plan (default: 12)"),
            option(
                "--free",
                type=int,
                metavar="N",
                help="so many of them are free poses (default: as the criterion chooses; without --count: N free poses)",
            ),
            option(
                "--setups",
                metavar="S,S",
                help="setups of the board to plan in (default: the table's own and those of the points); also roll-,"
                " pitch- (tilted the other way) and roll+pitch",
            ),
            option("--only", choices=("free", "table"), help="free poses only, or cavities only"),
            option(
                "--criterion",
                default="D",
                metavar="C",
                help="D (default), O1 to O5, or tip: the tip's uncertainty over the workspace",
            ),
            option(
                "--noise",
                type=float,
                metavar="M",
                help="standard deviation of a measured coordinate in m (default: the camera's)",
            ),
            option(
                "--view",
                type=float,
                nargs=6,
                metavar=("X0", "X1", "Y0", "Y1", "Z0", "Z1"),
                help="the box in the base frame that the camera sees, in m (default: everything)",
            ),
            option("--out", metavar="DIR", help="a folder for plan.csv and plan.json"),
            JSON,
        ),
        "Nothing moves. plan.csv is in visiting order, for `armwright session --plan`.",
    ),
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
                help="parameters that keep their value: theta4,tool_x",
            ),
            option(
                "--free",
                metavar="FRAMES",
                action="append",
                help="frames that are identified too: base, table, tool (boards of unknown place always are)",
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
                required=True,
                help="static poses, points.csv or .csv.gz; may be given several times",
            ),
            OUT,
            option(
                "--without",
                metavar="EFFECT",
                action="append",
                help="leave an effect out of the list of those that are tried",
            ),
            JSON,
        ),
        "Writes gap.json, arm.toml with what was named, and report.html to the folder; nothing is overwritten.",
    ),
    CommandSpec(
        "export",
        "turn a recording into log.csv.gz and MCAP",
        (
            option("recording", metavar="FILE", help="a .armlog file"),
            OUT,
            option("--every", type=int, default=1, metavar="K", help="keep every k-th cycle (default: 1)"),
        ),
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
                type=float,
                default=0.07,
                metavar="M",
                help="above the board, in m (default: 0.07)",
            ),
            option(
                "--path-speed",
                type=float,
                default=0.15,
                metavar="M_S",
                help="of the trajectories (default: 0.15)",
            ),
        ),
        "The arm must be homed and hold; the tip goes above the board by either model and the camera measures. Exit status 1"
        " where the calibrated arm is worse by more than chance.",
    ),
    CommandSpec(
        "export-arm",
        "write an arm as URDF, MJCF or JSON for other tools",
        (
            ARM,
            option(
                "--export",
                required=True,
                choices=("urdf", "mjcf", "json"),
                help="the form: URDF, MuJoCo's MJCF, or plain DH with transforms",
            ),
            option("--out", metavar="FILE", required=True, help="a new file; none is overwritten"),
        ),
        "Says what the form cannot hold. A joint angle of the exported model is the arm's own.",
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
                type=float,
                nargs="+",
                metavar="SHARE",
                help="path speeds as shares of the rated one (default: 0.1 0.5 1)",
            ),
            option(
                "--rated-speed",
                type=float,
                metavar="M_S",
                help="rated path speed (default: the fastest that the planner need not slow on the test line)",
            ),
            option(
                "--rated-load-kg",
                type=float,
                metavar="KG",
                help="loads up to this hang at the tip for the static compliance (default: none; with --mock 1)",
            ),
            option("--drift-s", type=float, metavar="S", help="how long drift is watched (default: 600)"),
            option(
                "--programmes",
                nargs="+",
                metavar="NAME",
                help="only these: pose directions distance drift path cornering posing load weaving",
            ),
            option(
                "--cube-centre",
                type=float,
                nargs=3,
                metavar=("X", "Y", "Z"),
                help="centre of the test cube in m",
            ),
            option(
                "--cube-edge",
                type=float,
                metavar="M",
                help="its edge (default: the largest cube within reach)",
            ),
            option(
                "--speed",
                type=float,
                metavar="F",
                help="of joint moves, a fraction of the joints' limits (default: 0.5; with --mock 1)",
            ),
            option(
                "--band-m",
                type=float,
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
    ),
    CommandSpec(
        "arm",
        "read an arm.toml and say what it holds",
        (option("arm", nargs="?", default="right", metavar="A"), JSON),
    ),
)
