"""Imported by the process that workers are forked from, so that each of them has everything at once."""

import importlib
import signal

# Who stops a server may tell its whole group; this process ends with the server, which needs it until then.
signal.signal(signal.SIGTERM, signal.SIG_IGN)
for _name in ("reloc.service.handler", "reloc.service.workers.answering", "reloc.service.live.frames"):
    importlib.import_module(_name)
# Compiling takes more than a worker may take for a photo.
for _name in ("featuredb.features.extractor", "featuredb.index.descriptor_index", "reloc.tracking.pose_fit"):
    importlib.import_module(_name).warm_up()
