"""The end of a process that serves."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from featuredb.stop_signals import sigterm_as_ctrl_c


def test_an_end_leaves_no_temporary_folder(tmp_path: Path) -> None:
    code = (
        "from reloc.service.workers.process import prepare_workers\n"
        "from featuredb.stop_signals import end_process\n"
        "import multiprocessing.util\n"
        "prepare_workers(); print(multiprocessing.util.get_temp_dir(), flush=True); end_process(3)"
    )
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=60.0,
    )
    assert done.returncode == 3
    assert Path(done.stdout.strip()).parent == tmp_path
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "work",
    [
        "import featuredb.adjust.problem",
        "import reloc.localise.pose",
        "from featuredb.geometry.camera import _pycolmap; _pycolmap()",
    ],
)
def test_a_process_that_adjusts_ends_as_others_do(work: str) -> None:
    """pyceres and pycolmap come with a handler of their own."""
    code = f"{work}; import os, signal; os.kill(os.getpid(), signal.SIGTERM)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False, timeout=60.0)
    assert (done.returncode, done.stderr) == (-signal.SIGTERM, b"")


def test_sigterm_interrupts_where_it_may() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt), sigterm_as_ctrl_c():
        signal.raise_signal(signal.SIGTERM)
    assert signal.getsignal(signal.SIGTERM) is before
