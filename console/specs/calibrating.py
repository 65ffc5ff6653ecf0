"""Commands that calibrate and verify an arm from measurements."""

from console.options import (
    ARM,
    BOARDS,
    JSON,
    OUT,
    SOCKET,
    CommandSpec,
    finite,
    option,
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

CALIBRATING = (
    CommandSpec(
        "calibrate",
        "identify the arm's parameters from recorded points, with their uncertainty",
        (
            ARM,
            points("points.csv or .csv.gz", is_required=True),
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
            option("--out", metavar="DIR", help="folder for the results; created if missing"),
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
        module="calibration.calibrate_pair",
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
    CommandSpec(
        "trust",
        "predict the tip's error over the workspace, of an arm from its points or of a design from its tolerances",
        (
            ARM,
            points(
                "points.csv or .csv.gz of the real arm; with --design: only their poses, as those of the calibration"
            ),
            OUT,
            option("--tolerance", metavar="LENGTH", help="the accuracy that is wanted, e.g. 0.5mm"),
            option(
                "--task",
                metavar="FILE",
                action="append",
                help="way-points as for `armwright run`: the probability that the path keeps the tolerance; may be repeated",
            ),
            payload(
                "mass at the tip that the map is made for (default: 0); may be repeated", action="append"
            ),
            BOARDS,
            option("--design", metavar="A", help="arm.toml of an arm to be built, instead of --arm"),
            option(
                "--tolerances",
                metavar="T",
                help="with --design: how exactly parts are made; a file, or `right`",
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
        "check-up",
        "decide from a few poses whether the arm is fine, needs a calibration, or has a joint to look at",
        (
            ARM,
            option(
                "--points",
                metavar="P",
                action="append",
                required=True,
                help="points.csv of the calibration: what the arm did before; may be repeated",
            ),
            option("--out", metavar="DIR", required=True, help="folder for the recording and check-up.json"),
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
            option("--scenario", metavar="S", help="with --mock: a scenario file or a name (default: demo)"),
            option("--seed", type=int, metavar="N", help="with --mock: seed of its hidden errors"),
            SOCKET,
            JSON,
        ),
        "The arm must be homed and holding, and a camera must see the tip; docs/check_up.md.",
        module="calibration.check_up",
    ),
    CommandSpec(
        "trend",
        "say from the record of calibrations what drifts, how fast, and when the next calibration is due",
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
                help="by how much the tip may drift, e.g. 0.5mm: when the next calibration is due",
            ),
            JSON,
        ),
        "Nothing moves. docs/trend.md.",
        module="calibration.trend",
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
            points("static poses, points.csv or .csv.gz"),
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
            scenario(default="demo"),
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
