"""Fetch the viewer's libraries from the npm registry: `python -m tools.vendor_viewer`.

The tarball of the pinned version is compared with the integrity hash below, the files that the page loads are
written to reloc/viewer/assets/vendor as they are, and `manifest.json` says what lies there. Neither npm nor
node is needed, and nothing is fetched when the package is installed or runs: the files are committed. For
another version change VERSION and INTEGRITY (`npm view three@VERSION dist.integrity`) and run it again.
"""

import argparse
import base64
import hashlib
import io
import json
import sys
import tarfile
import urllib.request
from pathlib import Path

# 0.185 is the last version that comes with minified builds; without them the page needs a bundler or 2 MB.
VERSION = "0.185.0"
INTEGRITY = "sha512-+yRrcRO2iZa8uzvNNl0d7cL4huhgKgBvVJ0njcTe8xFqZ6DMAFZdCKDP91SEAuj25bNAj7k1QQdf+srZywVK6w=="
REGISTRY = "https://registry.npmjs.org"
# What is taken out of the package, and what it is called here.
FILES = {
    "build/three.module.min.js": "three.module.min.js",
    "build/three.core.min.js": "three.core.min.js",
    "examples/jsm/controls/OrbitControls.js": "OrbitControls.js",
    "LICENSE": "LICENSE-three.txt",
}
FOLDER = Path(__file__).resolve().parent.parent / "reloc" / "viewer" / "assets" / "vendor"


def main() -> int:
    argparse.ArgumentParser(description="Fetch the viewer's libraries from the npm registry.").parse_args()
    with urllib.request.urlopen(f"{REGISTRY}/three/-/three-{VERSION}.tgz", timeout=60) as response:
        tarball = response.read()
    found = "sha512-" + base64.b64encode(hashlib.sha512(tarball).digest()).decode()
    if found != INTEGRITY:
        sys.stderr.write(f"three {VERSION}: expected {INTEGRITY}, found {found}; nothing is written\n")
        return 1
    FOLDER.mkdir(parents=True, exist_ok=True)
    digests = {}
    with tarfile.open(fileobj=io.BytesIO(tarball)) as archive:
        for inside, name in FILES.items():
            member = archive.extractfile(f"package/{inside}")
            assert member is not None, inside
            data = member.read()
            (FOLDER / name).write_bytes(data)
            digests[name] = hashlib.sha256(data).hexdigest()
    manifest = {"package": "three", "version": VERSION, "licence": "MIT", "integrity": INTEGRITY}
    text = json.dumps({**manifest, "sha256": digests}, indent=1)
    (FOLDER / "manifest.json").write_text(text + "\n", encoding="utf-8")
    sys.stdout.write(f"three {VERSION}: {len(digests)} files in {FOLDER}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
