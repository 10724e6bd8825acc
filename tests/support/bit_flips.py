"""Single bits turned over in every kind of file of a database, and what `verify` says of each.

python -m tests.support.bit_flips FLIPS SEED
"""

import os
import random
import shutil
import sys
import tempfile
from collections import Counter
from pathlib import Path

from featuredb.errors import FeatureDbError
from featuredb.store import Database
from featuredb.store.canaries import add_canary, list_canaries, load_canary_image
from featuredb.store.candidates.photos import contribute, list_candidates, load_images
from featuredb.store.durable import publish
from featuredb.store.encode import content_digest
from featuredb.store.verify import verify
from tests.support.contributions import contribution
from tests.support.maps import random_map


def rich_database(url: Path) -> Database:
    """A small database with every kind of file but scans: maps, photos, a known query, checkpoints."""
    database = Database.create(url)
    for seed in (1, 2):
        database.commit_map(random_map(seed, extent_m=10.0))
    database.retire("map-2", "wrong")
    contribute(database, [contribution(1)])
    add_canary(database, "gate", b"photo" * 50, None, origin="person")
    return database


def seen(database: Database) -> object:
    """All that a reader gets."""
    snapshot = database.snapshot()
    rows = snapshot.rows()
    maps = [(r["map_id"], r["status"], content_digest(snapshot.load_any(r["map_id"]))) for r in rows]
    photos = list_candidates(database)
    images = list(load_images(database, [photo.candidate_id for photo in photos]))
    known = [(repr(canary), load_canary_image(database, canary)) for canary in list_canaries(database)]
    return sorted(maps), photos, images, known


def files_of(database: Database) -> list[Path]:
    """The files that have bytes, relative to the database."""
    root = Path(database.url)
    return sorted(
        path.relative_to(root) for path in root.rglob("*") if path.is_file() and path.stat().st_size
    )


def outcome(database: Database, truth: object) -> str:
    """`found` by verify, `harmless` where a reader gets the same as before, else `missed`."""
    try:
        if not verify(database).ok:
            return "found"
    except FeatureDbError:
        return "found"
    try:
        return "harmless" if seen(database) == truth else "missed"
    except FeatureDbError:
        return "missed"


def flip_bits(database: Database, copy: Path, flips: int, seed: int) -> Counter[tuple[str, str]]:
    """How often each outcome was, by kind of file; file after file in turn, the bit by chance."""
    files, truth, rng = files_of(database), seen(database), random.Random(seed)
    found: Counter[tuple[str, str]] = Counter()
    for i in range(flips):
        path = files[i % len(files)]
        shutil.copytree(database.url, copy)
        content = bytearray((copy / path).read_bytes())
        content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
        (copy / path).write_bytes(content)
        found[f"{path.parts[0]}{path.suffix}", outcome(Database(str(copy)), truth)] += 1
        shutil.rmtree(copy)
    return found


def main(flips: int, seed: int) -> None:
    os.fsync = lambda fd: None
    publish.CHECKPOINT_INTERVAL = 2
    with tempfile.TemporaryDirectory() as folder:
        found = flip_bits(rich_database(Path(folder, "a.db")), Path(folder, "b.db"), flips, seed)
    for (kind, what), count in sorted(found.items()):
        sys.stdout.write(f"{kind:24} {what:9} {count}\n")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
