"""Commands that measure the arm on the calibration table."""

from console.options import (
    ARM,
    AS_GIVEN,
    BOARDS,
    JSON,
    OUT,
    SOCKET,
    CommandSpec,
    finite,
    option,
    payload,
    scenario,
)

RECORDING = (
    CommandSpec(
        "session",
        "step through the table's points, seat the tip and record; resumable at any time",
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
                help="number of sides from which each point is approached per round (default: 1)",
            ),
            option(
                "--free",
                metavar="N|FILE",
                help="number of free poses, or a file of them with q1_rad ...; needs --camera or --pictures",
            ),
            option(
                "--plan",
                metavar="FILE",
                help="points to record, from `armwright plan-poses`: setup,point, and q1_rad ... for setup free",
            ),
            payload("mass at the tip (default: 0)"),
            option(
                "--seat",
                choices=("hand", "jog"),
                help="guide the tip by hand with the drives off, or jog it (default: hand)",
            ),
            option(
                "--board",
                choices=("known", "measured", "unknown"),
                help="place of the board: from the file, from the camera, or unknown (default: from the file)",
            ),
            option(
                "--camera",
                action="store_true",
                default=None,
                help="also record the tip position from the camera",
            ),
            option(
                "--pictures",
                action="store_true",
                default=None,
                help="free poses for pictures that you take with a webcam: angles alone, and the name of each picture",
            ),
            option(
                "--mock",
                action="store_true",
                help="use a stepped mock arm with a mock hand that seats the tip",
            ),
            scenario(),
            option("--replay", metavar="SCRIPT", help="read answers from a file, one per line"),
            option("--json", action="store_true", help="print questions and records as JSON lines"),
            SOCKET,
            option(
                "--cell",
                metavar="C",
                help="two arms in contact: the cell.toml that `serve` runs (docs/two_arms.md)",
            ),
            option(
                "--contacts",
                metavar="FILE",
                help="with --cell: planned contacts, from `armwright plan-contacts`",
            ),
            option("--arms", nargs=2, metavar="ARM", help="with --cell: two arms of more"),
        ),
        "Each record is on disk before it is confirmed. The same command resumes; docs/session.md.",
        module="calibration.session",
    ),
    CommandSpec(
        "plan-poses",
        "choose the next points, tilts and free poses by their information",
        (
            ARM,
            option("--points", metavar="P", help="points.csv of the points recorded so far"),
            AS_GIVEN,
            BOARDS,
            option("--count", type=int, metavar="N", help="poses to plan (default: 12)"),
            option(
                "--free",
                type=int,
                metavar="N",
                help=(
                    "number of free poses among them (default: chosen by the criterion; without --count: N free"
                    " poses)"
                ),
            ),
            option(
                "--setups",
                metavar="S,S",
                help="setups of the board (default: those of the table and of the points); also roll-, pitch-"
                " (opposite tilt) and roll+pitch",
            ),
            option("--only", choices=("free", "table"), help="only free poses, or only cavities"),
            option(
                "--criterion",
                default="D",
                metavar="C",
                help="D (default), O1 to O5, or tip: the tip's uncertainty over the workspace",
            ),
            option(
                "--orientation-noise",
                metavar="ANGLE",
                help="orientations are measured beside tips, with this standard deviation, e.g. 0.5mrad (default: if the points"
                " have some)",
            ),
            option(
                "--noise",
                metavar="LENGTH",
                help="standard deviation of a measured coordinate, e.g. 0.2mm (default: the camera's)",
            ),
            option(
                "--view",
                type=finite,
                nargs=6,
                metavar=("X0", "X1", "Y0", "Y1", "Z0", "Z1"),
                help="box in the base frame that the camera sees, in m (default: everything)",
            ),
            option("--out", metavar="DIR", help="folder for plan.csv and plan.json"),
            JSON,
        ),
        "Nothing moves. plan.csv lists the poses in visiting order for `armwright session --plan`.",
        module="calibration.planning",
    ),
    CommandSpec(
        "register",
        "locate the calibration board from three or more markers seen by the camera",
        (
            ARM,
            option(
                "--markers",
                required=True,
                metavar="M",
                help="markers.csv: setup,marker,x_m,y_m,z_m in the base frame; a marker is named by its cavity",
            ),
            OUT,
            JSON,
        ),
        "Prints the residual of every marker, names outliers, writes boards.json.",
        module="calibration.importing",
    ),
)
