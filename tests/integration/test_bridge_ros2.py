"""`featuredb bridge ros2 --connect`: what a plain Zenoh session hears, taken apart as rmw_zenoh takes it."""

import json
import queue
import struct
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import zenoh
from rosbags.typesys import Stores, get_typestore

from featuredb.cli.main import main
from reloc.service.session import bind_free_port
from tests.support.command_line import only_command
from tests.unit.test_bridge import GIVEN, ORIGIN, PLACE, TIME_S, answer, body_from_angles

_DOMAIN, _SOON_S = 7, 20.0
_TYPES = {
    "featuredb/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "featuredb/fix": "sensor_msgs/msg/NavSatFix",
    "tf": "tf2_msgs/msg/TFMessage",
}


@pytest.fixture
def router() -> Iterator[tuple[zenoh.Session, str]]:
    """Stands for ROS 2's router and a node in one: a peer that listens."""
    endpoint = bind_free_port("tcp/127.0.0.1:0")
    config = zenoh.Config()
    config.insert_json5("listen/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as session:
        yield session, endpoint


def _until(line: str, heard: Callable[[], bool]) -> Iterator[str]:
    """Answers until they are heard: a publisher may put its first ones before it knows who listens."""
    end = time.monotonic() + _SOON_S
    while not heard() and time.monotonic() < end:
        yield line
        time.sleep(0.02)


def test_ros_2_hears_the_poses_and_sees_the_node(
    router: tuple[zenoh.Session, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    session, endpoint = router
    heard: queue.Queue[zenoh.Sample] = queue.Queue()
    seen: queue.Queue[zenoh.Sample] = queue.Queue()
    before_ns = time.time_ns()
    with (
        session.declare_subscriber(f"{_DOMAIN}/**", heard.put),
        session.liveliness().declare_subscriber(f"@ros2_lv/{_DOMAIN}/**", seen.put),
        only_command(monkeypatch, "bridge", "reloc.cli.bridge:register"),
    ):
        line = json.dumps(answer(body_from_angles())) + "\n"
        monkeypatch.setattr("sys.stdin", _until(line, lambda: heard.qsize() >= 12 and seen.qsize() >= 4))
        origin = f"--origin={ORIGIN.latitude_deg},{ORIGIN.longitude_deg},{ORIGIN.height_m}"
        assert main(["bridge", "ros2", "--connect", endpoint, "--domain", str(_DOMAIN), origin]) == 0
        samples = [heard.get_nowait() for _ in range(heard.qsize())]
        tokens = [seen.get(timeout=_SOON_S) for _ in range(8)]

    store, gids, told = get_typestore(Stores.ROS2_JAZZY), {}, {}
    for sample in samples:
        domain, *topic, mangled, type_hash = str(sample.key_expr).split("/")
        package, _, _, name = mangled.split("::")
        kind = f"{package}/msg/{name.removesuffix('_')}"
        assert (int(domain), kind) == (_DOMAIN, _TYPES["/".join(topic)])
        assert type_hash == store.hash_rihs01(kind)
        assert sample.attachment is not None
        number, stamp_ns, length, gid = struct.unpack("<qqB16s", sample.attachment.to_bytes())
        assert before_ns <= stamp_ns <= time.time_ns()
        assert length == 16
        gids.setdefault(kind, set()).add(gid)
        told.setdefault(kind, {})[number] = store.deserialize_cdr(sample.payload.to_bytes(), kind)
    assert len(told) == 3
    assert all(len(found) >= 2 for found in told.values())
    assert [len(found) for found in gids.values()] == [1, 1, 1]
    assert len(set.union(*gids.values())) == 3
    pose = list(told[_TYPES["featuredb/pose"]].values())[-1]
    at = pose.pose.pose.position
    np.testing.assert_allclose([at.x, at.y, at.z], PLACE, atol=1e-6)
    swap = [3, 4, 5, 0, 1, 2]
    covariance = pose.pose.covariance.reshape(6, 6)
    np.testing.assert_allclose(covariance, GIVEN[np.ix_(swap, swap)], atol=1e-5)
    assert pose.header.stamp.sec == int(TIME_S)

    declared = [str(s.key_expr) for s in tokens if s.kind == zenoh.SampleKind.PUT]
    ended = [str(s.key_expr) for s in tokens if s.kind == zenoh.SampleKind.DELETE]
    assert sorted(declared) == sorted(ended)
    keys = {str(sample.key_expr) for sample in samples}
    nodes, publishers = set(), set()
    for token in declared:
        root, domain, zid, nid, own, entity, enclave, namespace, node, *topic = token.split("/")
        assert (root, domain, nid, enclave, namespace, node) == (
            *("@ros2_lv", str(_DOMAIN), "0"),
            *("%", "%", "featuredb"),
        )
        nodes.add((zid, nid))
        if entity == "NN":
            assert not topic
            continue
        assert entity == "MP"
        name, mangled, type_hash, qos = topic
        assert (name[0], qos) == ("%", "::,10:,:,:,,")  # reliable, volatile, the last ten
        publishers.add((own, f"{domain}/{name[1:].replace('%', '/')}/{mangled}/{type_hash}"))
    assert len(nodes) == 1
    assert {key for _, key in publishers} == keys
    assert len({own for own, _ in publishers}) == 3


def test_where_nobody_listens_the_command_says_what_is_missing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("reloc.bridge.ros2._CONNECT_TIMEOUT_S", 0.2)
    with only_command(monkeypatch, "bridge", "reloc.cli.bridge:register"):
        assert main(["bridge", "ros2", "--connect", bind_free_port("tcp/127.0.0.1:0")]) == 2
        assert "rmw_zenohd), such as tcp/127.0.0.1:7447, found nobody" in capsys.readouterr().err
        assert main(["bridge", "ros2"]) == 2
        assert "expected --out FILE.mcap, --connect ENDPOINT or both" in capsys.readouterr().err
