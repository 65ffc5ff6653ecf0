"""Every subcommand, in the order of `armwright --help`."""

from console.options import ARM, JSON, LINKS, OUT, RATE, SOCKET, CommandSpec, option

COMMANDS = (
    CommandSpec(
        "demo",
        "the whole job on a mock arm: home, move, record the table, calibrate, verify, report",
        (
            option(
                "--out", default="out/demo", metavar="DIR", help="where the results go (default: out/demo)"
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
                default="demo",
                metavar="S",
                help="a scenario file or the name of one that ships",
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
        "export",
        "turn a recording into log.csv.gz and MCAP",
        (
            option("recording", metavar="FILE", help="a .armlog file"),
            OUT,
            option("--every", type=int, default=1, metavar="K", help="keep every k-th cycle (default: 1)"),
        ),
    ),
    CommandSpec(
        "arm",
        "read an arm.toml and say what it holds",
        (option("arm", nargs="?", default="right", metavar="A"), JSON),
    ),
)
