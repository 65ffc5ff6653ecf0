"""Commands that measure the arm on the calibration table."""

from console.options import ARM, AS_GIVEN, BOARDS, JSON, OUT, SOCKET, CommandSpec, finite, option, payload, scenario

RECORDING = (
    CommandSpec(
        "session",
        "step through the table's points, seat the tip and record; resumable at any time",
        (
            ARM,
            OUT,
            option("--setups S,...", "tilts of the board, in order (default: those of the table)"),
            option("--points P,...", "cavities by name: 1,2,5-9 (default: all)"),
            option("--repeats N", "rounds of every point (default: 1)", type=int),
            option(
                "--approaches",
                "number of sides from which each point is approached per round (default: 1)",
                type=int,
                choices=(1, 2),
            ),
            option("--free N|FILE", "number of free poses, or a file of them with q1_rad ...; needs --camera or --pictures"),
            option("--plan FILE", "points to record, from `armwright plan-poses`: setup,point, and q1_rad ... for setup free"),
            payload("mass at the tip (default: 0)"),
            option("--seat", "guide the tip by hand with the drives off, or jog it (default: hand)", choices=("hand", "jog")),
            option(
                "--board",
                "place of the board: from the file, from the camera, or unknown (default: from the file)",
                choices=("known", "measured", "unknown"),
            ),
            option("--camera", "also record the tip position from the camera", default=None),
            option(
                "--pictures",
                "free poses for pictures that you take with a webcam: angles alone, and the name of each picture",
                default=None,
            ),
            option(
                "--seen RAD",
                "with --free N: joint angles at which the camera sees the target from the front; poses that show it, too",
                type=finite,
                nargs="+",
            ),
            option("--mock", "use a stepped mock arm with a mock hand that seats the tip"),
            scenario(),
            option("--replay SCRIPT", "read answers from a file, one per line"),
            option("--json", "print questions and records as JSON lines"),
            SOCKET,
            option("--cell C", "two arms in contact: the cell.toml that `serve` runs (docs/two_arms.md)"),
            option("--contacts FILE", "with --cell: planned contacts, from `armwright plan-contacts`"),
            option("--arms ARM", "with --cell: two arms of more", nargs=2),
        ),
        "Each record is on disk before it is confirmed. The same command resumes; docs/session.md.",
        module="calibration.session",
    ),
    CommandSpec(
        "plan-poses",
        "choose the next points, tilts and free poses by their information",
        (
            ARM,
            option("--points P", "points.csv of the points recorded so far"),
            AS_GIVEN,
            BOARDS,
            option("--count N", "poses to plan (default: 12)", type=int),
            option(
                "--free N",
                "number of free poses among them (default: chosen by the criterion; without --count: N free poses)",
                type=int,
            ),
            option(
                "--setups S,S",
                "setups of the board (default: those of the table and of the points); also roll-, pitch-"
                " (opposite tilt) and roll+pitch",
            ),
            option("--only", "only free poses, or only cavities", choices=("free", "table")),
            option("--criterion C", "D (default), O1 to O5, or tip: the tip's uncertainty over the workspace", default="D"),
            option(
                "--orientation-noise ANGLE",
                "orientations are measured beside tips, with this standard deviation, e.g. 0.5mrad (default: if the points"
                " have some)",
            ),
            option("--noise LENGTH", "standard deviation of a measured coordinate, e.g. 0.2mm (default: the camera's)"),
            option(
                "--view X0 X1 Y0 Y1 Z0 Z1",
                "box in the base frame that the camera sees, in m (default: everything)",
                type=finite,
                nargs=6,
            ),
            option("--out DIR", "folder for plan.csv and plan.json"),
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
                "--markers M",
                "markers.csv: setup,marker,x_m,y_m,z_m in the base frame; a marker is named by its cavity",
                required=True,
            ),
            OUT,
            JSON,
        ),
        "Prints the residual of every marker, names outliers, writes boards.json.",
        module="calibration.importing",
    ),
)
