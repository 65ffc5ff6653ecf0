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
    option("--history FILE", "append the result to this record, which `armwright trend` reads"),
    option("--measured DATE", "with --history: when the data were recorded, e.g. 2026-11-23 (default: now)"),
)

BOUND = option(
    "--bound NAME=VALUE",
    "largest deviation: lengths=5mm, angles=2deg (the defaults), or one parameter, e.g. L2=8mm",
    action="append",
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
                "--objective NAME",
                "e2: sum of distances, the paper's (default); e1: sum of absolute coordinates; lsq: least squares; huber",
                default="e2",
            ),
            option("--huber-threshold LENGTH", "distance above which huber is linear, e.g. 0.3mm (default: from the noise)"),
            BOUND,
            option(
                "--fix NAMES",
                "parameters to keep fixed: theta4,tool_x; base: the tips are in the arm's base frame; target: the axes of"
                " measured orientations are the last link's",
                action="append",
            ),
            option(
                "--orientation-noise ANGLE",
                "standard deviation of measured orientations, e.g. 0.5mrad (default: arm.toml's [camera], else 2mrad)",
            ),
            option(
                "--free FRAMES",
                "frames to identify too: base, table, tool (boards and trackers of unknown place always are)",
                action="append",
            ),
            option(
                "--effect EFFECT",
                "static effects to identify too: backlash:2, joint_compliance:2, encoder_scale:1, belt_coupling",
                action="append",
            ),
            BOARDS,
            option("--accuracy LENGTH", "required mean error (a in E <= k a); warns if it cannot be met"),
            option("--without POSE", "omit SETUP, SETUP:POINT or SETUP:POINT:REPEAT; may be repeated", action="append"),
            option("--leave-out WHAT", "held-out part: setups, or k for every k-th point (default: setups if there are several)"),
            option("--export FORMS", "also write urdf, mjcf or json", action="append"),
            option("--starts N", "number of random starts (default: 4)", type=int, default=4),
            option("--seed N", "seed of the random starts (default: 0)", type=int, default=0),
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
                "--arms A B",
                "arm.toml of both, or names of supplied arms; the result is in the base frame of the first",
                nargs=2,
                required=True,
            ),
            option(
                "--contacts FILE",
                "contacts.csv or .csv.gz: the joints of the first arm, then of the second (docs/two_arms.md)",
                required=True,
            ),
            out_unless("--choose"),
            option("--objective NAME", "huber (default), e2, lsq or e1, as for `armwright calibrate`", default="huber"),
            option("--bound NAME=VALUE", "largest deviations: lengths=5mm, angles=2deg (the defaults)", action="append"),
            option("--fix NAMES", "parameters to keep fixed: left_theta4,right_L2", action="append"),
            option("--free-tool ARMS", "arms whose tip is identified too: left,right", action="append"),
            option(
                "--choose N",
                "write nothing: print the N contacts of the file that say most (D-optimal), the best first",
                type=int,
            ),
            option("--noise LENGTH", "with --choose: noise of a contact (default: 0.2mm)"),
            JSON,
        ),
        "Nothing moves. Writes both arms' files and pair.json; never overwrites.",
        module="calibration.calibrate",
    ),
    CommandSpec(
        "plan-contacts",
        "choose where the tips of two arms should meet, for `armwright calibrate-pair`",
        (
            option("--cell C", "a cell.toml, or the name of a supplied cell (default: pair)", default="pair"),
            option("--arms A B", "two arms of a cell that has more", nargs=2),
            option("--count N", "how many contacts (default: 40)", type=int, default=40),
            option("--distance LENGTH", "between the tips, in turns: 0mm is one place, 100mm a bar (default: 0mm)", nargs="+"),
            option("--out FILE", "write them as contacts.csv, the most valuable first"),
        ),
        "Nothing moves. Contacts are within reach of both arms, and clear of each other by clearance_m and 30 mm.",
        module="calibration.planning",
    ),
    CommandSpec(
        "calibrate-distances",
        "identify the arm from lengths: draw wires, dial gauges, ball bars, distances between two poses of the tip",
        (
            ARM,
            option("--points P", "points.csv with the columns distance_of and distance_m (docs/distances.md)", required=True),
            OUT,
            option(
                "--objective",
                "huber: outliers count less (default); lsq: least squares",
                default="huber",
                choices=("huber", "lsq"),
            ),
            BOUND,
            option("--fix NAMES", "parameters to keep fixed: theta4,L2", action="append"),
            WIRE_AT,
            option("--free-tool", "identify where the tip is, too"),
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
            option("file FILE", "text with a header line: a row for each pose, joint angles and measured tip"),
            ARM,
            option("--columns OURS=THEIRS", 'what the header does not tell: q1_rad="Axis A"', nargs="+"),
            option("--angles UNIT", "rad or deg (default: as the header says)"),
            option("--lengths UNIT", "m, cm, mm or in (default: as the header says)"),
            OUT,
        ),
        "Nothing moves. Says what it understood, asks what the table does not tell, and never overwrites.",
        module="calibration.importing",
    ),
    CommandSpec(
        "import-capture",
        "points from a recording of a motion capture system (Vicon CSV, C3D), on the time of the encoders",
        (
            option("file FILE", "a .csv that Tracker or Nexus has exported, or a .c3d"),
            ARM,
            option("--log FILE", "log.csv of the same motion"),
            option("--run NAME", "the captured run of the log (default: all, if on one clock)"),
            option("--body NAME", "the body at the tip: its name, a marker, or three or more markers: A+B+C"),
            option("--base-body NAME", "a body on the arm's base: tips are relative to it"),
            option(
                "--board-markers SETUP",
                "instead of points: markers.csv of the markers that stand in the board's cavities and are called like them",
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
                "board: a target to print; calibrate: the lens, from pictures of a board; poses: the target, in pictures"
                " of the arm",
                choices=("board", "calibrate", "poses"),
            ),
            option("--images DIR", "folder of pictures; poses: one for each --camera", action="append"),
            option("--board CxR", "a ChArUco board of columns x rows squares, e.g. 5x7"),
            option("--square LENGTH", "edge of a square, measured on the print, e.g. 30mm"),
            option("--marker LENGTH", "edge of the markers in it (default: 0.75 of a square)"),
            option("--tag N", "a single AprilTag or ArUco tag by its number", type=int),
            option("--size LENGTH", "edge of the tag's black square, e.g. 50mm"),
            option("--tags FILE", "tags.csv: several tags of one body (docs/webcam.md)"),
            option("--dictionary NAME", "OpenCV's name of the markers (default: 4x4_250 for boards, apriltag_36h11 for tags)"),
            option("--legacy", "the board was printed by OpenCV before 4.6"),
            option("--camera FILE", "poses: camera.json; one for each camera", action="append"),
            option("--points P", "poses: points.csv with the joint angles of each picture"),
            option(
                "--readout-s S", "calibrate: time from the first to the last row of a rolling shutter (default: 0)", type=finite
            ),
            option("--tip-speed M_S", "poses: the fastest that the target may have moved in a picture (default: 0)", type=finite),
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
            option("--log L", "time series, log.csv or .csv.gz; may be repeated", action="append"),
            out_unless("--plan-only"),
            option("--without EFFECT", "do not try this effect; may be repeated", action="append"),
            option("--map", "measure the residual as maps of the joints, which the controller corrects"),
            option(
                "--current-unit",
                "what the columns i1_A ... hold: currents, percent of the drives' limits, torques of joints or motors",
                default="A",
                choices=("A", "mA", "percent", "Nm", "motor_Nm"),
            ),
            *HISTORY,
            JSON,
            option("--record", "plan and record poses and motions first; the same --out resumes"),
            option("--mock", "with --record: use a mock arm in this process"),
            scenario(),
            option("--seed N", "seed of the mock arm's hidden errors", type=int),
            option("--quick", "with --record: fewer poses, shorter motions"),
            option("--minutes M", "with --record: as much as fits in this time", type=finite),
            payload("mass attached to the tip for part of the recording (default: none; mock: 0.5)"),
            option("--only", "with --record: poses only, or motions only", choices=("static", "motion")),
            option("--plan-only", "with --record: print the plan and the effects that it can reveal; nothing moves"),
            option("--record-only", "with --record: do not analyse yet"),
            SOCKET,
        ),
        "Writes gap.json, an arm.toml with the named effects, and report.html; never overwrites. `armwright gap"
        " --points points.csv --log log.csv --out out/gap` analyses files. `armwright gap --record --plan-only`"
        " prints the plan. `armwright gap --record --mock --quick --out out/gap` tries it on a mock arm.",
        module="calibration.gap",
    ),
)
