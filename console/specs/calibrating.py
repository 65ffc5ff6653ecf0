"""Commands that identify arms and cameras from measurements."""

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

HISTORY = (
    option(
        "--history", metavar="FILE", help="append the result to this record, which `armwright trend` reads"
    ),
    option(
        "--measured",
        metavar="DATE",
        help="with --history: when the data were recorded, e.g. 2026-11-23 (default: now)",
    ),
)

BOUND = option(
    "--bound",
    metavar="NAME=VALUE",
    action="append",
    help="largest deviation: lengths=5mm, angles=2deg (the defaults), or one parameter, e.g. L2=8mm",
)

CALIBRATING = (
    CommandSpec(
        "calibrate",
        "identify the arm's parameters from recorded points, with their uncertainty",
        (
            ARM,
            points("points.csv or .csv.gz", is_required=True),
            AS_GIVEN,
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
            BOUND,
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
            BOARDS,
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
            *HISTORY,
            JSON,
        ),
        "Writes arm.toml, calibration.json and report.html; never overwrites.",
        module="calibration.calibrate",
    ),
    CommandSpec(
        "calibrate-pair",
        "identify two arms whose tips touch, and where they stand to each other, without a camera",
        (
            option(
                "--arms",
                nargs=2,
                required=True,
                metavar=("A", "B"),
                help="arm.toml of both, or names of supplied arms; the result is in the base frame of the first",
            ),
            option(
                "--contacts",
                required=True,
                metavar="FILE",
                help="contacts.csv or .csv.gz: the joints of the first arm, then of the second (docs/two_arms.md)",
            ),
            out_unless("--choose"),
            option(
                "--objective",
                default="huber",
                metavar="NAME",
                help="huber (default), e2, lsq or e1, as for `armwright calibrate`",
            ),
            option(
                "--bound",
                metavar="NAME=VALUE",
                action="append",
                help="largest deviations: lengths=5mm, angles=2deg (the defaults)",
            ),
            option(
                "--fix",
                metavar="NAMES",
                action="append",
                help="parameters to keep fixed: left_theta4,right_L2",
            ),
            option(
                "--free-tool",
                metavar="ARMS",
                action="append",
                help="arms whose tip is identified too: left,right",
            ),
            option(
                "--choose",
                type=int,
                metavar="N",
                help="write nothing: print the N contacts of the file that say most (D-optimal), the best first",
            ),
            option("--noise", metavar="LENGTH", help="with --choose: noise of a contact (default: 0.2mm)"),
            JSON,
        ),
        "Nothing moves. Writes both arms' files and pair.json; never overwrites.",
        module="calibration.calibrate",
    ),
    CommandSpec(
        "plan-contacts",
        "choose where the tips of two arms should meet, for `armwright calibrate-pair`",
        (
            option(
                "--cell",
                metavar="C",
                default="pair",
                help="a cell.toml, or the name of a supplied cell (default: pair)",
            ),
            option("--arms", nargs=2, metavar=("A", "B"), help="two arms of a cell that has more"),
            option("--count", type=int, default=40, metavar="N", help="how many contacts (default: 40)"),
            option(
                "--distance",
                nargs="+",
                metavar="LENGTH",
                help="between the tips, in turns: 0mm is one place, 100mm a bar (default: 0mm)",
            ),
            option("--out", metavar="FILE", help="write them as contacts.csv, the most valuable first"),
        ),
        "Nothing moves. Contacts are within reach of both arms, and clear of each other by clearance_m and 30 mm.",
        module="calibration.planning",
    ),
    CommandSpec(
        "calibrate-distances",
        "identify the arm from lengths: draw wires, dial gauges, ball bars, distances between two poses of the tip",
        (
            ARM,
            option(
                "--points",
                required=True,
                metavar="P",
                help="points.csv with the columns distance_of and distance_m (docs/distances.md)",
            ),
            OUT,
            option(
                "--objective",
                default="huber",
                choices=("huber", "lsq"),
                help="huber: outliers count less (default); lsq: least squares",
            ),
            BOUND,
            option(
                "--fix",
                metavar="NAMES",
                action="append",
                help="parameters to keep fixed: theta4,L2",
            ),
            WIRE_AT,
            option("--free-tool", action="store_true", help="identify where the tip is, too"),
            FREE_ZERO,
            JSON,
        ),
        "Nothing moves. Writes arm.toml and calibration.json; never overwrites.",
        module="calibration.calibrate",
    ),
    CommandSpec(
        "import-points",
        "points.csv of a table that another program wrote: any separator, decimal mark, encoding, unit and column names",
        (
            option(
                "file",
                metavar="FILE",
                help="text with a header line: a row for each pose, joint angles and measured tip",
            ),
            ARM,
            option(
                "--columns",
                metavar="OURS=THEIRS",
                nargs="+",
                help='what the header does not tell: q1_rad="Axis A"',
            ),
            option("--angles", metavar="UNIT", help="rad or deg (default: as the header says)"),
            option("--lengths", metavar="UNIT", help="m, cm, mm or in (default: as the header says)"),
            OUT,
        ),
        "Nothing moves. Says what it understood, asks what the table does not tell, and never overwrites.",
        module="calibration.importing",
    ),
    CommandSpec(
        "import-capture",
        "points from a recording of a motion capture system (Vicon CSV, C3D), on the time of the encoders",
        (
            option("file", metavar="FILE", help="a .csv that Tracker or Nexus has exported, or a .c3d"),
            ARM,
            option("--log", metavar="FILE", help="log.csv of the same motion"),
            option(
                "--run", metavar="NAME", help="the captured run of the log (default: all, if on one clock)"
            ),
            option(
                "--body",
                metavar="NAME",
                help="the body at the tip: its name, a marker, or three or more markers: A+B+C",
            ),
            option("--base-body", metavar="NAME", help="a body on the arm's base: tips are relative to it"),
            option(
                "--board-markers",
                metavar="SETUP",
                help="instead of points: markers.csv of the markers that stand in the board's cavities and are called like them",
            ),
            OUT,
            JSON,
        ),
        "Nothing moves. Writes points.csv, and log.csv with tips if the frame is placed; never overwrites.",
        module="calibration.importing",
    ),
    CommandSpec(
        "camera",
        "measure the arm with a webcam: print a target, calibrate the lens, measure the target's pose in pictures",
        (
            option(
                "what",
                choices=("board", "calibrate", "poses"),
                help="board: a target to print; calibrate: the lens, from pictures of a board; poses: the target, in pictures"
                " of the arm",
            ),
            option(
                "--images",
                metavar="DIR",
                action="append",
                help="folder of pictures; poses: one for each --camera",
            ),
            option("--board", metavar="CxR", help="a ChArUco board of columns x rows squares, e.g. 5x7"),
            option("--square", metavar="LENGTH", help="edge of a square, measured on the print, e.g. 30mm"),
            option(
                "--marker", metavar="LENGTH", help="edge of the markers in it (default: 0.75 of a square)"
            ),
            option("--tag", type=int, metavar="N", help="a single AprilTag or ArUco tag by its number"),
            option("--size", metavar="LENGTH", help="edge of the tag's black square, e.g. 50mm"),
            option("--tags", metavar="FILE", help="tags.csv: several tags of one body (docs/webcam.md)"),
            option(
                "--dictionary",
                metavar="NAME",
                help="OpenCV's name of the markers (default: 4x4_250 for boards, apriltag_36h11 for tags)",
            ),
            option("--legacy", action="store_true", help="the board was printed by OpenCV before 4.6"),
            option(
                "--camera", metavar="FILE", action="append", help="poses: camera.json; one for each camera"
            ),
            option("--points", metavar="P", help="poses: points.csv with the joint angles of each picture"),
            option(
                "--readout-s",
                type=finite,
                metavar="S",
                help="calibrate: time from the first to the last row of a rolling shutter (default: 0)",
            ),
            option(
                "--tip-speed",
                type=finite,
                metavar="M_S",
                help="poses: the fastest that the target may have moved in a picture (default: 0)",
            ),
            OUT,
            JSON,
        ),
        "Nothing moves. Needs OpenCV: pip install 'armwright[camera]'. docs/webcam.md.",
        module="calibration.camera",
    ),
)


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
