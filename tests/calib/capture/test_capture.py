"""Recordings of motion capture: what files say, the time by a motion, the poses at rest, and the command."""

from __future__ import annotations

import dataclasses
import json
import struct
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.arm_problem.assembly import Choice, problem_of
from calib.boards import read_markers
from calib.capture.alignment import JointMotion, align
from calib.capture.poses import believed, poses_at_rest
from calib.capture.tracks import BodyTrack, Capture, CaptureError, fitted_body, read_c3d, read_vicon_csv, relative
from calib.gap.log import read_log
from calib.identify.identification import identify
from calib.points.points import read_points
from console.main import main
from control.model.description import save_arm
from control.model.end_effector import Camera, CameraStream
from control.model.table import board_cavities, table_of
from tests.calib.capture.recordings import (
    RIGHT,
    SYSTEM,
    Both,
    CAPTURE_Hz,
    MARKERS_m,
    NOISE_m,
    NOISE_rad,
    SYSTEM_m,
    both,
    c3d_bytes,
    vicon_csv,
    write_log,
)


def motion_of(made: Both) -> JointMotion:
    from calib.capture.alignment import _speeds

    return JointMotion(made.t_s, made.q_rad, _speeds(made.t_s, made.q_rad))


@pytest.mark.parametrize("seed", [1, 2])
def test_the_time_is_found_with_an_arm_that_is_not_calibrated_and_a_body_beside_the_tip(seed: int) -> None:
    made = both(seed)
    alignment = align(RIGHT, motion_of(made), made.tau_s, BodyTrack(made.place_m))
    assert abs(alignment.offset_s - 2.3217) < max(4.0 * alignment.offset_sd_s, 2e-5)
    assert alignment.offset_sd_s < 1e-4
    assert (alignment.rate, alignment.rate_sd) == (0.0, 0.0)
    assert alignment.residual_m < 2.0 * NOISE_m
    assert "begins at 2.32" in alignment.in_words()


def test_a_long_recording_tells_how_fast_the_clocks_run() -> None:
    made = both(3, span_s=90.0, rate=40e-6)
    alignment = align(RIGHT, motion_of(made), made.tau_s, BodyTrack(made.place_m))
    assert alignment.rate == pytest.approx(40e-6, abs=max(4.0 * alignment.rate_sd, 1e-7))
    assert abs(alignment.offset_s - 2.3217) < max(4.0 * alignment.offset_sd_s, 5e-5)


def test_a_motion_that_repeats_itself_or_is_another_one_cannot_tell_the_time() -> None:
    made = both(4, span_s=24.0, poses=2)
    with pytest.raises(CaptureError, match="cannot tell the time: shifted by"):
        align(RIGHT, motion_of(made), made.tau_s[:1200], BodyTrack(made.place_m[:1200]))
    with pytest.raises(CaptureError, match=r"agree nowhere|cannot tell the time|disagree by"):
        align(RIGHT, motion_of(both(5)), made.tau_s, BodyTrack(both(6, span_s=24.0).place_m))
    still = np.tile(made.place_m[:1], (len(made.tau_s), 1))
    with pytest.raises(CaptureError, match="in which both tip and body move"):
        align(RIGHT, motion_of(made), made.tau_s, BodyTrack(still))
    with pytest.raises(CaptureError, match="seen for less than 3 s"):
        align(RIGHT, motion_of(made), made.tau_s[:200], BodyTrack(made.place_m[:200]))


def test_rests_become_poses_whose_covariances_are_right_and_hidden_ones_are_said() -> None:
    made = both(7, span_s=40.0)
    place = np.array(made.place_m)
    place[600:800] = np.nan
    rotation = np.where(np.isnan(place)[:, :, None], np.nan, made.rotation)
    motion, body = motion_of(made), BodyTrack(place, rotation)
    rests = poses_at_rest(motion, made.tau_s, body, align(RIGHT, motion, made.tau_s, body))
    assert len(rests.points) >= 12
    assert any("the body is hidden in" in said for said in rests.left_out)
    assert rests.noise_m == pytest.approx(NOISE_m, rel=0.05)
    assert rests.noise_rad == pytest.approx(NOISE_rad, rel=0.05)
    sd = np.sqrt(rests.points.covariance[:, 0])
    assert np.all((sd > 0.5 * NOISE_m / np.sqrt(70)) & (sd < 2.0 * NOISE_m / np.sqrt(20)))
    assert set(np.unique(rests.points.direction)) <= {-1.0, 0.0, 1.0}
    choice = Choice().for_points(RIGHT, rests.points)
    assert choice.freed == ("camera",)
    arm = dataclasses.replace(RIGHT, tool=dataclasses.replace(RIGHT.tool, known=False))
    made_of = identify(problem_of(arm, rests.points, choice), starts_count=1)
    assert made_of.mean_after_m < 3e-4 < made_of.mean_before_m
    assert made_of.weighted is not None
    assert 0.5 < made_of.weighted < 1.6


@pytest.mark.parametrize("hunting_rad", [0.0, 3e-4])
@pytest.mark.parametrize("count_rad", [1e-5, 1.5e-3])
def test_an_arm_rests_that_hunts_about_its_place_or_whose_counts_flicker(hunting_rad: float, count_rad: float) -> None:
    made = both(7, span_s=40.0)
    hunt = hunting_rad * np.sin(2.0 * np.pi * 4.0 * made.t_s)  # at up to 7.5 mrad/s
    q_rad = np.round((made.q_rad + hunt[:, None]) / count_rad) * count_rad
    counted, still = JointMotion(made.t_s, q_rad, q_rad).rests(0.7), motion_of(made).rests(0.7)
    assert len(counted) == len(still) >= 18
    assert np.array(counted) == pytest.approx(np.array(still), abs=0.15)


def test_a_body_of_markers_is_seen_while_three_of_them_are() -> None:
    made = both(8, span_s=8.0)
    markers = np.array(made.markers_m)
    markers[3, 10:20] = np.nan  # three are left
    markers[2:, 30:40] = np.nan  # two are left
    body = fitted_body("t", markers)
    assert body.rotation is not None
    assert body.is_seen.tolist() == [not 30 <= k < 40 for k in range(markers.shape[1])]
    seen = body.is_seen
    off = Rotation.from_matrix(body.rotation[seen]).inv() * Rotation.from_matrix(made.rotation[seen])
    assert off.magnitude().max() < 0.03
    assert off.mean().magnitude() < 1e-3
    with pytest.raises(CaptureError, match="on one line"):
        fitted_body("t", np.stack([np.add(markers[0], (0.1 * k, 0.0, 0.0)) for k in range(3)]))
    with pytest.raises(CaptureError, match="no frame shows all"):
        fitted_body("t", np.full((3, 5, 3), np.nan))


def test_bodies_that_exchange_their_names_are_not_believed_meanwhile() -> None:
    made = both(9, span_s=8.0)
    other = np.tile([[0.5, -0.25, 0.125]], (len(made.tau_s), 1))
    one, two = np.array(made.place_m), np.array(other)
    one[100:150], two[100:150] = other[100:150], made.place_m[100:150]
    capture = Capture(Path("x.csv"), made.tau_s, {}, {})
    bodies, said = believed(capture, {"tool": BodyTrack(one), "wand": BodyTrack(two)})
    assert np.flatnonzero(~bodies["tool"].is_seen).tolist() == list(range(100, 150))
    assert said == (
        "body tool and wand exchanged their names at frame 100",
        "body wand and tool exchanged their names at frame 100",
    )


def test_a_base_body_that_moves_is_refused() -> None:
    made = both(10, span_s=8.0)
    with pytest.raises(CaptureError, match="the base body moves by"):
        relative(BodyTrack(made.place_m), BodyTrack(made.place_m, made.rotation))


def test_vicons_csv_is_read_with_units_names_and_hidden_frames(tmp_path: Path) -> None:
    made = both(11, span_s=6.0)
    (tmp_path / "v.csv").write_text(vicon_csv(made, hidden=slice(5, 9)))
    capture = read_vicon_csv(tmp_path / "v.csv")
    tool = capture.body("tool")
    assert np.flatnonzero(~tool.is_seen).tolist() == [5, 6, 7, 8]
    seen = tool.is_seen
    np.testing.assert_allclose(tool.position_m[seen], made.place_m[seen], atol=1e-8)
    assert tool.rotation is not None
    np.testing.assert_allclose(tool.rotation[seen], made.rotation[seen], atol=2e-6)
    np.testing.assert_allclose(capture.markers["arm:M1"], made.markers_m[0], atol=1e-7)
    np.testing.assert_allclose(capture.t_s, made.tau_s, atol=1e-12)
    with pytest.raises(CaptureError, match=r"expected one of tool, base, arm:M1"):
        capture.body("hand")
    quaternion = "Objects\n100\n,,a,,,,,,\nFrame,Sub Frame,RX,RY,RZ,RW,TX,TY,TZ\n,,,,,,m,m,m\n1,0,0,0,0.6,0.8,1,2,3\n"
    (tmp_path / "q.csv").write_text(quaternion)
    rotation = read_vicon_csv(tmp_path / "q.csv").body("a").rotation
    assert rotation is not None
    np.testing.assert_allclose(rotation[0, :2, 0], (0.28, 0.96), atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("Objects", "Subjects", None),
        ("Objects\n120", "Objects\nfast", 'line 2: got "fast", expected a number'),
        ("Frame,Sub Frame,RX", "Bild,Sub Frame,RX", "line 4: expected the columns Frame, Sub Frame"),
        ("RX,RY,RZ,TX,TY,TZ,RX", "RX,RY,RZ,TX,TY,RX", "expected RX RY RZ"),
        ("rad,rad,rad,mm,mm,mm,rad", "rad,rad,rad,inch,mm,mm,rad", 'line 5: got the unit "inch"'),
        ("\n3,0,", "\n2,0,", "line 8: got frame 2, expected one after 2"),
        ("Trajectories\n120", "Trajectories\n240", "other rates or frames"),
    ],
)
def test_a_vicon_file_that_is_wrong_is_one_message(tmp_path: Path, old: str, new: str, said: str | None) -> None:
    text = vicon_csv(both(11, span_s=4.5)).replace(old, new, 1)
    (tmp_path / "v.csv").write_text(text)
    if said is None:
        assert not read_vicon_csv(tmp_path / "v.csv").bodies  # only the markers are left
        return
    with pytest.raises(CaptureError, match=said):
        read_vicon_csv(tmp_path / "v.csv")


@pytest.mark.parametrize("kind", [84, 85, 86])
@pytest.mark.parametrize("is_float", [True, False])
def test_c3d_of_every_processor_is_read(tmp_path: Path, kind: int, is_float: bool) -> None:
    markers = np.array(both(12, span_s=5.0).markers_m[:, :50])
    markers[1, 7] = np.nan
    (tmp_path / "x.c3d").write_bytes(c3d_bytes(markers, kind, is_float))
    capture = read_c3d(tmp_path / "x.c3d")
    assert list(capture.markers) == ["M1", "M2", "M3", "M4"]
    for k, places in enumerate(capture.markers.values()):
        np.testing.assert_allclose(places, markers[k], atol=6e-5 if not is_float else 2e-7)
    assert capture.t_s[-1] == pytest.approx(49 / CAPTURE_Hz)


def test_a_c3d_file_that_is_wrong_or_cut_is_one_message(tmp_path: Path) -> None:
    whole = c3d_bytes(both(12, span_s=5.0).markers_m[:, :20])
    for content, said in (
        (b"", "second byte"),
        (whole[:300], "second byte"),
        (whole[:515] + b"\x10" + whole[516:], "processor type 16"),
        (whole[:-9], "20 frames of 4 points do not fit"),
        (whole.replace(b"RATE", b"RITE"), "POINT:RATE is missing"),
        (whole.replace(b"\x02mm", b"\x02in"), 'lengths in "in"'),
    ):
        (tmp_path / "x.c3d").write_bytes(content)
        with pytest.raises(CaptureError, match=said):
            read_c3d(tmp_path / "x.c3d")


def with_trial(whole: bytes, frames: int) -> bytes:
    """A file with TRIAL:ACTUAL_START_FIELD 1 and ACTUAL_END_FIELD, in two words each."""
    records = struct.pack("bb", 5, -2) + b"TRIAL" + struct.pack("<h", 3) + b"\0"
    for name, value in ((b"ACTUAL_START_FIELD", 1), (b"ACTUAL_END_FIELD", frames)):
        body = struct.pack("bBB", 2, 1, 2) + struct.pack("<HH", value % 65536, value // 65536) + b"\0"
        records += struct.pack("bb", len(name), 2) + name + struct.pack("<h", 2 + len(body)) + body
    end = whole.index(b"LABELS") + len(b"LABELS") + 2
    end += struct.unpack_from("<h", whole, end - 2)[0] - 2
    assert not any(whole[end : end + len(records)])
    return whole[:end] + records + whole[end + len(records) :]


def test_a_c3d_longer_than_sixteen_bits_count_is_read_to_its_end(tmp_path: Path) -> None:
    places = np.zeros((1, 70_000, 3))
    places[0, :, 0] = np.arange(70_000) * 1e-5
    whole = c3d_bytes(places[:, :1], labels=("M",))
    data = np.zeros((70_000, 5), dtype="<f4")
    data[:, 0] = 1e3 * places[0, :, 0]
    whole = whole[:1536] + data.tobytes()
    whole = whole[:8] + struct.pack("<H", 65535) + whole[10:]
    (tmp_path / "x.c3d").write_bytes(with_trial(whole, 70_000))
    capture = read_c3d(tmp_path / "x.c3d")
    assert len(capture.t_s) == 70_000
    assert capture.markers["M"][-1, 0] == pytest.approx(places[0, -1, 0], rel=1e-6)
    assert capture.notes == ()
    (tmp_path / "x.c3d").write_bytes(whole)  # nothing but the header's 16 bits
    cut = read_c3d(tmp_path / "x.c3d")
    assert len(cut.t_s) == 65_535
    assert "65535 frames are stated, and there is room for 70000" in cut.notes[0]


@pytest.mark.parametrize("kind", [84, 85, 86])
@pytest.mark.parametrize("name", ["USED", "RATE", "SCALE", "DATA_START"])
def test_a_c3d_parameter_that_is_zero_is_taken_from_the_header(tmp_path: Path, name: str, kind: int) -> None:
    markers = np.array(both(12, span_s=5.0).markers_m[:, :20])
    whole = c3d_bytes(markers, kind)
    at = whole.index(name.encode()) + len(name) + 4  # after the step, the type and no dimensions
    width = 4 if name in ("RATE", "SCALE") else 2
    (tmp_path / "x.c3d").write_bytes(whole[:at] + bytes(width) + whole[at + width :])
    capture = read_c3d(tmp_path / "x.c3d")
    np.testing.assert_allclose(capture.markers["M2"], markers[1], atol=2e-7)
    assert capture.t_s[-1] == pytest.approx(19 / CAPTURE_Hz)


def test_other_peoples_c3d_is_read_alike(tmp_path: Path) -> None:
    c3d = pytest.importorskip("c3d", reason="needs the writer that is the witness: pip install c3d")
    markers = both(13, span_s=5.0).markers_m[:, :30]
    writer = c3d.Writer(point_rate=CAPTURE_Hz, analog_rate=CAPTURE_Hz)
    writer.set_analog_labels(["force"])
    writer.set_point_labels([f"M{k}" for k in range(4)])
    for frame in range(30):
        points = np.zeros((4, 5), dtype=np.float32)
        points[:, :3] = 1e3 * markers[:, frame]
        points[2, 3] = -1.0 if frame == 3 else 0.0
        writer.add_frames([(points, np.zeros((1, 1)))])
    with (tmp_path / "w.c3d").open("wb") as file:
        writer.write(file)
    capture = read_c3d(tmp_path / "w.c3d")
    np.testing.assert_allclose(capture.markers["M1"], markers[1], atol=2e-7)
    assert np.isnan(capture.markers["M2"][3]).all()


def test_ezc3ds_files_in_metres_and_beside_analog_channels_are_read_alike(tmp_path: Path) -> None:
    ezc3d = pytest.importorskip("ezc3d", reason="needs the writer that is the witness: pip install ezc3d")
    markers = np.array(both(13, span_s=5.0).markers_m[:, :30])
    markers[2, 3] = np.nan
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["RATE"]["value"] = [CAPTURE_Hz]
    file["parameters"]["POINT"]["UNITS"]["value"] = ("m",)
    file["parameters"]["POINT"]["LABELS"]["value"] = tuple(f"arm:M{k}" for k in range(4))
    file["parameters"]["ANALOG"]["RATE"]["value"] = [10.0 * CAPTURE_Hz]
    file["parameters"]["ANALOG"]["LABELS"]["value"] = ("force", "torque")
    file["data"]["points"] = np.vstack((markers.transpose(2, 0, 1), np.ones((1, 4, 30))))
    file["data"]["analogs"] = np.ones((1, 2, 300))
    file.write(str(tmp_path / "e.c3d"))
    capture = read_c3d(tmp_path / "e.c3d")
    np.testing.assert_allclose(np.stack(list(capture.markers.values())), markers, atol=2e-7)
    assert list(capture.markers) == ["M0", "M1", "M2", "M3"]


def test_the_command_writes_points_of_the_stream_and_says_what_it_cannot_use(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = both(14, span_s=14.0)
    log = write_log(tmp_path / "log.csv", made)
    (tmp_path / "v.csv").write_text(vicon_csv(made))
    (tmp_path / "x.c3d").write_bytes(c3d_bytes(made.markers_m))
    given = ["import-capture", str(tmp_path / "v.csv"), "--log", str(log), "--out", str(tmp_path / "out")]
    assert main([*given, "--body", "tool", "--base-body", "base", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["offset_s"] == pytest.approx(2.3217, abs=1e-4)
    points, _ = read_points(tmp_path / "out" / "points.csv", 3)
    assert (len(points), points.in_camera_frame) == (content["poses"], True)
    assert np.isfinite(points.covariance).all()
    assert main([*given, "--body", "tool"]) == 2
    assert "never overwritten" in capsys.readouterr().err
    other = [*given[:-1], str(tmp_path / "two")]
    for more, text in (
        (["--body", "hand"], 'no body "hand": expected one of tool, base, arm:M1'),
        (["--body", "tool", "--base-body", "tool"], "the base body moves by"),
        (["--body", "base"], "in which both tip and body move"),
        (["--body", "tool", "--run", "7"], 'no run "7": expected one of 1'),
    ):
        assert main([*other, *more]) == 2
        assert text in capsys.readouterr().err
    assert main([other[0], str(tmp_path / "x.c3d"), *other[2:], "--body", "M1+M2+M3+M4"]) == 0
    assert "poses at rest; noise of a frame 0." in capsys.readouterr().out


def test_the_command_writes_the_log_with_tips_once_the_frame_is_placed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = both(14, span_s=14.0)
    back = SYSTEM.inv()
    stream = CameraStream("vicon", "tool", origin_m=tuple(-back.apply(SYSTEM_m)), orientation=_wxyz(back))
    save_arm(dataclasses.replace(RIGHT, camera=Camera(stream=stream)), tmp_path / "arm.toml")
    log = write_log(tmp_path / "log.csv", made)
    (tmp_path / "v.csv").write_text(vicon_csv(made))
    given = ["import-capture", str(tmp_path / "v.csv"), "--log", str(log), "--body", "tool", "--json"]
    assert main([*given, "--out", str(tmp_path / "a")]) == 0  # an arm without a stream
    content = json.loads(capsys.readouterr().out)
    assert content["log"] is None
    assert "no time stamps of the encoder boards" in content["said"][0]
    assert main([*given, "--arm", str(tmp_path / "arm.toml"), "--out", str(tmp_path / "b")]) == 0
    (run,) = read_log(Path(json.loads(capsys.readouterr().out)["log"]), 3)[0].runs
    seen = np.isfinite(run.tip_m[:, 0])
    assert seen.sum() == len(made.tau_s)
    in_base = back.apply(made.place_m - SYSTEM_m)
    true = np.column_stack([np.interp(run.t_s[seen] - 2.3217, made.tau_s, in_base[:, k]) for k in range(3)])
    assert np.median(np.abs(run.tip_m[seen] - true)) < 2.0 * NOISE_m
    np.testing.assert_allclose(run.q_rad, made.q_rad, atol=1e-5)


def test_runs_with_clocks_of_their_own_are_not_joined(tmp_path: Path) -> None:
    text = write_log(tmp_path / "a.csv", both(15, span_s=5.0)).read_text()
    (tmp_path / "b.csv").write_text(text + text.replace("\n1,", "\n2,").partition("\n")[2])
    log, _ = read_log(tmp_path / "b.csv", 3)
    with pytest.raises(CaptureError, match=r"clocks of their own.*\(1, 2\)"):
        JointMotion.of(log, None)
    assert len(JointMotion.of(log, "2")[0].t_s) == 1000


def test_runs_of_our_own_exports_are_put_on_one_clock_and_what_is_before_homing_is_left_out(tmp_path: Path) -> None:
    made = both(16, span_s=6.0)
    q = np.array(made.q_rad)
    q[:200, 2] -= 0.7  # before its zero was known
    lines = ["run,t_s,q1_rad,q2_rad,q3_rad,cycle"]
    for k, row in enumerate(q):
        run, begin = (1, 0) if k < 700 else (2, 700)
        lines.append(f"{run},{made.t_s[k] - made.t_s[begin]:.4f},{row[0]:.6f},{row[1]:.6f},{row[2]:.6f},{50 + k}")
    (tmp_path / "log.csv").write_text("\n".join(lines) + "\n")
    motion, said = JointMotion.of(read_log(tmp_path / "log.csv", 3)[0], None)
    np.testing.assert_allclose(motion.t_s, made.t_s[200:], atol=1e-6)
    assert "before 1.00 s is not used: an angle leaps there" in said[0]


def test_markers_in_the_boards_cavities_are_said_in_the_base_frame_and_register_the_board(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place, turn = np.array([-0.12, 0.08, 0.05]), Rotation.from_rotvec([0.3, -0.2, 0.9])
    stream = CameraStream("vicon", "tool", "M1+M2+M3+M4", origin_m=tuple(place), orientation=_wxyz(turn))
    save_arm(dataclasses.replace(RIGHT, camera=Camera(stream=stream)), tmp_path / "arm.toml")
    standing = Rotation.from_rotvec([0.0, 0.0, 0.02])
    cavities = {name: board_cavities(table_of(RIGHT))[name] for name in ("1", "5", "9", "17", "25")}
    in_base = standing.apply(list(cavities.values())) + np.array([0.51, 0.01, 0.002])
    shape = MARKERS_m - MARKERS_m.mean(axis=0)  # x to the second, z normal to three: its own frame
    seen = np.concatenate((shape, turn.inv().apply(in_base - place)))
    tracks = np.repeat(seen[:, None], 30, axis=1) + np.random.default_rng(1).normal(0.0, 1e-4, (9, 30, 3))
    labels = ("M1", "M2", "M3", "M4", *(f"table:{name}" for name in cavities))
    (tmp_path / "b.c3d").write_bytes(c3d_bytes(tracks, labels=labels))
    given = ["import-capture", str(tmp_path / "b.c3d"), "--arm", str(tmp_path / "arm.toml"), "--out", str(tmp_path)]
    assert main([*given, "--base-body", "M1+M2+M3+M4", "--board-markers", "normal"]) == 0
    found = read_markers(tmp_path / "markers.csv")
    np.testing.assert_allclose(found.seen_m, in_base, atol=5e-4)
    assert main(["register", "--arm", "right", "--markers", str(tmp_path / "markers.csv"), "--out", str(tmp_path)]) == 0
    capsys.readouterr()
    other = [*given[:-1], str(tmp_path / "two")]
    for more, said in (
        (["--board-markers", "normal"], 'base_body = "" and origin_m'),
        (["--board-markers", "normal", "--body", "x"], "leave --log, --body"),
        ([], "expected --log, the arm's log.csv"),
    ):
        assert main([*other, *more]) == 2
        assert said in capsys.readouterr().err


def _wxyz(turn: Rotation) -> tuple[float, float, float, float]:
    x, y, z, w = turn.as_quat().tolist()
    return w, x, y, z
