"""Commands that measure the arm on the calibration table."""

from console.options import ARM, JSON, OUT, SOCKET, CommandSpec, finite, option

RECORDING = (
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
            option("--payload", type=finite, metavar="KG", help="mass at the tip (default: 0)"),
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
            option(
                "--json", action="store_true", help="questions and records as JSON lines, for another program"
            ),
            SOCKET,
        ),
        "Each record is on disk before it is acknowledged. The same command resumes; docs/session.md.",
        module="calibration.session",
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
                type=finite,
                metavar="M",
                help="standard deviation of a measured coordinate in m (default: the camera's)",
            ),
            option(
                "--view",
                type=finite,
                nargs=6,
                metavar=("X0", "X1", "Y0", "Y1", "Z0", "Z1"),
                help="the box in the base frame that the camera sees, in m (default: everything)",
            ),
            option("--out", metavar="DIR", help="a folder for plan.csv and plan.json"),
            JSON,
        ),
        "Nothing moves. plan.csv is in visiting order, for `armwright session --plan`.",
        module="calibration.plan_poses",
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
            JSON,
        ),
        "Prints the residual of every marker, names those that disagree, writes boards.json.",
        module="calibration.register",
    ),
)
