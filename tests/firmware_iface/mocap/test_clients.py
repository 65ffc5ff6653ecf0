"""Other people's clients read what the mock motion capture systems send: `natnet` and `qtm-rt` (Qualisys's own), from PyPI."""

from __future__ import annotations

import math
import struct
from dataclasses import replace

import numpy as np
import pytest

from hil_mocks.devices.cameras import (
    FIRST_ID,
    CameraSetup,
    MEAN_ERROR_m,
    MocapMock,
    NatNetMock,
    QtmMock,
    RESIDUAL_mm,
    SceneSetup,
    TARGET_turn_rad,
    rotation_of,
)
from tests.firmware_iface.mocap.standing import Standing

PLACE, TIP_m = (1.4, -0.9, 0.2), (0.5, 0.1, 0.3)
TURN = rotation_of((0.1, -0.2, 2.0))
SCENE = SceneSetup("tool", "base", PLACE, (0.1, -0.2, 2.0), 0.0)
AXES = ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
SEEN_m = TURN.T @ (np.array(TIP_m) - PLACE)
SEEN_TURN = TURN.T @ np.array(AXES).T @ rotation_of(TARGET_turn_rad)


def packet_of(mock: MocapMock) -> bytes:
    (packet,) = mock.tick(1.5, Standing(TIP_m, AXES))
    return packet


def test_the_natnet_client_reads_bodies_names_and_server() -> None:
    why = "needs the client that is the witness: pip install natnet"
    frames = pytest.importorskip("natnet.data_frame", reason=why)
    models = pytest.importorskip("natnet.data_descriptions", reason=why)
    from natnet.packet_buffer import PacketBuffer
    from natnet.server_info import ServerInfo
    from natnet.version import Version

    mock, version = NatNetMock(CameraSetup(noise_m=0.0), SCENE), Version(4, 1)
    read = frames.DataFrame.read_from_buffer(PacketBuffer(packet_of(mock)[4:]), version)
    body = read.rigid_bodies[0]
    assert (read.prefix.frame_number, read.suffix.timestamp, len(read.rigid_bodies)) == (1, 1.5, 3)
    assert (body.id_num, body.tracking_valid) == (FIRST_ID, True)
    assert body.marker_error == pytest.approx(MEAN_ERROR_m)
    np.testing.assert_allclose(body.pos, SEEN_m, atol=1e-6)
    x, y, z, w = body.rot
    angle = 2.0 * math.atan2(math.hypot(x, y, z), w)
    axis = tuple(angle * v / math.hypot(x, y, z) for v in (x, y, z))
    np.testing.assert_allclose(rotation_of(axis), SEEN_TURN, atol=1e-6)
    (answer,) = mock.answer(struct.pack("<HH", 4, 0))
    described = models.DataDescriptions.read_from_buffer(PacketBuffer(answer[4:]), version)
    assert [(one.id_num, one.name) for one in described.rigid_bodies] == [(11, "tool"), (12, "wand"), (13, "base")]
    (answer,) = mock.answer(struct.pack("<HH", 0, 5) + b"Ping\0")
    info = ServerInfo.read_from_buffer(PacketBuffer(answer[4:]), version)
    assert (info.application_name, str(info.nat_net_protocol_version)) == ("Motive", "4.1.0.0")


def test_qualisys_own_client_reads_commands_and_bodies() -> None:
    packets = pytest.importorskip("qtm_rt.packet", reason="needs the vendor's client: pip install qtm-rt")
    from qtm_rt.receiver import Receiver

    mock = QtmMock(CameraSetup(noise_m=0.0), SCENE)
    got: dict[object, list[object]] = {kind: [] for kind in packets.QRTPacketType}
    receiver = Receiver({kind: got[kind].append for kind in got})
    asked = [b"", *(struct.pack("<II", 9 + len(text), 1) + text + b"\0" for text in (b"version 1.19", b"getparameters 6d"))]
    answers = b"".join(answer for request in asked for answer in mock.answer(request))
    mock.answer(struct.pack("<II", 0, 1) + b"streamframes allframes 6dres\0")
    for byte in answers + packet_of(mock):
        receiver.data_received(bytes([byte]))
    kinds = packets.QRTPacketType
    assert got[kinds.PacketCommand] == [b"QTM RT Interface connected", b"Version set to 1.19"]
    (xml,) = got[kinds.PacketXML]
    assert isinstance(xml, bytes)
    assert b"<Name>wand</Name>" in xml
    (data,) = got[kinds.PacketData]
    assert (data.timestamp, data.framenumber) == (1_500_000, 1)  # type: ignore[attr-defined]
    _, bodies = data.get_6d_residual()  # type: ignore[attr-defined]
    position, rotation, residual = bodies[0]
    np.testing.assert_allclose(position, 1e3 * SEEN_m, rtol=1e-6)
    np.testing.assert_allclose(np.reshape(rotation.matrix, (3, 3)).T, SEEN_TURN, atol=1e-6)
    assert residual.residual == pytest.approx(RESIDUAL_mm)


def test_hidden_bodies_are_marked_as_each_system_marks_them() -> None:
    hidden = replace(CameraSetup(noise_m=0.0), dropout=1.0)
    natnet, qtm = NatNetMock(hidden, SCENE), QtmMock(hidden, SCENE)
    qtm.answer(struct.pack("<II", 0, 1) + b"streamframes allframes 6dres\0")
    assert struct.pack("<i", 11) + bytes(34) in packet_of(natnet)
    assert struct.pack("<f", math.nan) in packet_of(qtm)
