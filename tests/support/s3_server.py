"""S3-compatible servers on loopback, for tests: Ceph's Object Gateway (a real one), and moto.

Each context manager yields the storage options with which deltalake reaches the server, and has made BUCKET.
"""

import shutil
import socket
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from pyarrow.fs import S3FileSystem

BUCKET = "featuredb-test"
ACCESS_KEY, SECRET_KEY, REGION = "featuredbkey", "featuredbsecret", "us-east-1"
START_TIMEOUT_S = 90  # a Ceph cluster takes about 15 s on a busy machine with two cores
CEPH_PROGRAMS = ("ceph", "ceph-mon", "ceph-osd", "monmaptool", "radosgw", "radosgw-admin")

# A whole cluster in one folder and in memory: one monitor, one object store daemon, no authentication between
# the daemons (hence no encryption to the monitor), no background work.
_CEPH_CONF = """
[global]
fsid = {fsid}
mon host = [v2:127.0.0.1:{monitor_port}/0]
mon initial members = a
public addr = 127.0.0.1
cluster addr = 127.0.0.1
auth cluster required = none
auth service required = none
auth client required = none
ms mon client mode = crc
ms mon service mode = crc
ms mon cluster mode = crc
keyring = {folder}/keyring
run dir = {folder}
pid file = {folder}/$name.pid
admin socket = {folder}/$name.asok
log file = {folder}/$name.log
mon data = {folder}/mon
osd data = {folder}/osd
rgw data = {folder}/rgw
mon allow pool size one = true
osd pool default size = 1
osd pool default min size = 1
osd pool default pg num = 1
osd pool default pgp num = 1
osd pool default pg autoscale mode = off
osd crush chooseleaf type = 0
osd objectstore = memstore
memstore device bytes = 1073741824
rgw frontends = beast endpoint=127.0.0.1:{gateway_port}
rgw enable usage log = false
rgw run sync thread = false
rgw enable gc threads = false
rgw enable lc threads = false
rgw enable quota threads = false
"""


def missing_ceph_programs() -> list[str]:
    """What of Ceph is not installed; Debian's packages are radosgw, ceph-mon and ceph-osd."""
    return [program for program in CEPH_PROGRAMS if shutil.which(program) is None]


@contextmanager
def ceph_gateway(folder: Path) -> Iterator[dict[str, str]]:
    """A Ceph cluster with an Object Gateway, all below `folder` (short: it holds sockets)."""
    for name in ("mon", "osd", "rgw"):
        (folder / name).mkdir(parents=True)
    (folder / "keyring").touch()
    conf, monmap = folder / "ceph.conf", folder / "monmap"
    fsid, osd_uuid = str(uuid.uuid4()), str(uuid.uuid4())
    monitor_port, gateway_port = free_port(), free_port()
    conf.write_text(
        _CEPH_CONF.format(folder=folder, fsid=fsid, monitor_port=monitor_port, gateway_port=gateway_port)
    )
    with_conf = ("-c", str(conf))
    with ExitStack() as stack:
        _run(
            "monmaptool", "--create", "--fsid", fsid, "--addv", "a", f"[v2:127.0.0.1:{monitor_port}]", monmap
        )
        _run("ceph-mon", "--mkfs", "-i", "a", *with_conf, "--monmap", monmap)
        stack.enter_context(daemon("ceph-mon", "-i", "a", "-f", *with_conf))
        _run("ceph", *with_conf, "osd", "new", osd_uuid)
        _run("ceph-osd", "-i", "0", "--mkfs", "--osd-uuid", osd_uuid, *with_conf)
        stack.enter_context(daemon("ceph-osd", "-i", "0", "-f", *with_conf))
        _run(
            "radosgw-admin", *with_conf, "user", "create", "--uid", "test", "--display-name", "test",
            "--access-key", ACCESS_KEY, "--secret", SECRET_KEY,
        )  # fmt: skip
        stack.enter_context(daemon("radosgw", "-n", "client.admin", "-f", *with_conf))
        yield _options_with_bucket(gateway_port)


@contextmanager
def moto_server() -> Iterator[dict[str, str]]:
    """moto's S3 in memory.

    Without threads: moto checks If-None-Match and then stores, and two threads could both pass the check.
    """
    port = free_port()
    code = (
        "from moto.server import create_backend_app\n"
        "from werkzeug.serving import run_simple\n"
        f"run_simple('127.0.0.1', {port}, create_backend_app('s3'), threaded=False)\n"
    )
    with daemon(sys.executable, "-c", code):
        yield _options_with_bucket(port)


def free_port() -> int:
    """A port on loopback that was free a moment ago."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _run(*command: str | Path) -> None:
    subprocess.run([str(c) for c in command], check=True, capture_output=True, timeout=START_TIMEOUT_S)


@contextmanager
def daemon(*command: str) -> Iterator[None]:
    """A process that is killed at the end."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield
    finally:
        process.kill()
        process.wait()


def wait_for(port: int) -> None:
    """Until a server on loopback listens."""
    deadline = time.monotonic() + START_TIMEOUT_S
    while True:
        try:
            socket.create_connection(("127.0.0.1", port), timeout=1).close()
            break
        except OSError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.1)


def _options_with_bucket(port: int) -> dict[str, str]:
    """Wait for the server, make the bucket."""
    wait_for(port)
    S3FileSystem(
        access_key=ACCESS_KEY,
        secret_key=SECRET_KEY,
        region=REGION,
        endpoint_override=f"http://127.0.0.1:{port}",
        allow_bucket_creation=True,
        request_timeout=START_TIMEOUT_S,
    ).create_dir(BUCKET)
    return {
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
        "AWS_ACCESS_KEY_ID": ACCESS_KEY,
        "AWS_SECRET_ACCESS_KEY": SECRET_KEY,
        "AWS_REGION": REGION,
        "AWS_ALLOW_HTTP": "true",
    }
