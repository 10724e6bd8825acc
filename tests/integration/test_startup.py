"""What a command imports before it does anything: seconds, where it is more than it needs."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from featuredb.store import Database
from tests.support.maps import random_map

# Each takes from a tenth of a second to two seconds.
_HEAVY = (
    "av", "cv2", "distributed", "faiss", "fastapi", "laspy", "matplotlib", "numba", "pandas", "poselib",
    "pyceres", "pycolmap", "pydantic", "rasterio", "scipy", "zenoh",
)  # fmt: skip
_PROGRAM = f"""
import json, sys
from featuredb.cli.main import program
sys.argv[0] = "featuredb"
code = program()
loaded = sorted(set(sys.modules) & set({_HEAVY!r} + ("deltalake", "numpy", "pyarrow", "pyproj")))
sys.stderr.write(json.dumps(loaded))
sys.exit(code)
"""


def loaded_by(*words: str) -> tuple[list[str], str]:
    """Which of the heavy packages a command has imported, and what it wrote."""
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM, *words], capture_output=True, text=True, check=True, timeout=60.0
    )
    loaded: list[str] = json.loads(done.stderr)
    return loaded, done.stdout


def test_help_imports_nothing_heavy() -> None:
    loaded, said = loaded_by("--help")
    assert loaded == []
    for command in ("maps", "ingest", "serve", "anchor", "view"):  # of each package
        assert f"\n    {command} " in said


def test_import_featuredb_is_light_and_says_all_that_it_has() -> None:
    code = (
        "import sys, featuredb; from importlib.metadata import version\n"
        "assert dir(featuredb) == ['Camera', 'FeatureDatabase', 'FeatureDbError', '__version__', 'open']\n"
        "assert featuredb.__version__ == version('featuredb')\n"
        f"heavy = set({_HEAVY!r} + ('deltalake', 'numpy', 'pyarrow', 'pyproj', 'ingest', 'reloc'))\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)\n"
        "assert all(getattr(featuredb, name) for name in dir(featuredb))"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60.0)


# A map's place is told at its middle, and UTM is PROJ's.
@pytest.mark.parametrize(("command", "more"), [("maps", ["pyproj"]), ("history", []), ("lineage", [])])
def test_looking_at_a_database_imports_what_reads_it(tmp_path: Path, command: str, more: list[str]) -> None:
    Database.create(tmp_path / "db").commit_map(random_map(1))
    loaded, said = loaded_by(command, str(tmp_path / "db"))
    assert loaded == ["deltalake", "numpy", "pyarrow", *more]
    assert "map-1" in said


def test_pandas_is_there_for_who_wants_it() -> None:
    pytest.importorskip("pandas")
    code = (
        "import sys; from featuredb.extras import leave_out_pandas; leave_out_pandas()\n"
        "import pyarrow as pa, pyarrow.dataset as ds; pa.array([1.0]); assert 'pandas' not in sys.modules\n"
        "assert ds.dataset(pa.table({'a': [1, 2]})).to_table().to_pandas()['a'].sum() == 3\n"
        "import pandas; assert pa.array(pandas.Series([1.0, None])).null_count == 1"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60.0)


def test_workers_are_forked_with_compiled_loops() -> None:
    """To compile takes longer than a worker may take for a photo."""
    code = (
        "import reloc.service.workers.preload; from featuredb.features import pyramid_loops, sift_loops\n"
        "from featuredb.index import distance_loops\nfrom reloc.tracking import fit_loops\n"
        "sets = ((pyramid_loops, 'blur'), (sift_loops, 'extrema orientations descriptors'),\n"
        "    (distance_loops, 'pair_distances'), (fit_loops, 'linearised'))\n"
        "for loops, names in sets:\n"
        "    for name in names.split():\n"
        "        assert len(getattr(loops, name).signatures) == 1, name"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120.0)
