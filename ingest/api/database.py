"""`featuredb.open`: a database as notebooks and programs use it."""

from collections.abc import Collection, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, Unpack

from featuredb.errors import InvalidValueError
from featuredb.export.formats_known import ExportedMaps, export_maps
from featuredb.export.selection import Selection
from featuredb.geometry.camera import Camera
from featuredb.maps.feature_map import GeoPrior
from featuredb.store import Database
from featuredb.store.durable.making import check_place
from featuredb.store.sql import SqlSession, SqlTable
from ingest.anchoring import AnchorRequest, anchor
from ingest.api.anchor_words import anchoring_text
from ingest.api.ingesting import IngestChoices, as_path, check_kind, ingest, ingest_options, several
from ingest.api.progress_bars import progress_bars
from ingest.api.registering import place_by_control
from ingest.api.results import Aligned, FilmTrack, Grown, Ingested, ListedMaps
from ingest.api.tracking import track_film
from ingest.growing import GrowingOptions, grow_candidates
from ingest.photos.scan import require_photos
from ingest.register.anchor.start.first_place import Circle, StartFiles
from ingest.track.finders import FilmBy, FilmGround
from reloc.asking import Image, PhotoAnswer, PhotoAsker
from reloc.tracking.track_video import TrackVideoOptions
from reloc.wire.query import CameraRequest, PriorRequest

PathLike = str | Path


class FeatureDatabase:
    """Feature maps of places: made of photos, placed on Earth, asked where photos were taken.

    Made by `featuredb.open`. Every method raises FeatureDbError, in one sentence, where it cannot do what it
    is asked. What a photo or a map does not allow (not localised, not placed) is a value, and no error.

    Attributes:
        store: the tables, for programs that need more.
    """

    def __init__(self, store: Database) -> None:
        self.store = store
        self._asker = PhotoAsker(store)

    @property
    def url(self) -> str:
        """Where it is."""
        return self.store.url

    @property
    def name(self) -> str:
        """What it calls itself in answers."""
        return self._asker.name

    @property
    def maps(self) -> ListedMaps:
        """The maps of the newest version that are not retired: ids, places, counts."""
        snapshot = self.store.snapshot()
        placed = tuple(snapshot.maps())
        return ListedMaps(
            placed=placed, unplaced=tuple(snapshot.unplaced_maps()), bounds=snapshot.place_bounds()
        )

    def __repr__(self) -> str:
        return f"<featuredb {self.url}, version {self.store.poll_version()}>"

    def _repr_html_(self) -> str:
        return f"<p>{self!r}</p>".replace("<featuredb", "&lt;featuredb") + self.maps._repr_html_()

    def ingest(
        self,
        photos: PathLike,
        *,
        report: PathLike | None = None,
        quiet: bool = False,
        **choices: Unpack[IngestChoices],
    ) -> Ingested:
        """Make maps of photos, place them and commit them. Killed, it goes on where it was.

        Args:
            photos: a folder, searched through; a table of photos; or OpenDroneMap's geo.txt (docs/ingest.md).
            report: folder for report.html and report.json.
            quiet: no progress bars.
            choices: see IngestChoices; `name`, `camera_model`, `gps_sigma` (m), `workers` and more.

        Raises:
            IngestError: fewer than two usable photos. InvalidValueError: a choice that cannot be.
        """
        options = ingest_options(**choices)
        require_photos(as_path(photos))
        done = ingest(self.store, as_path(photos), options, report=_path(report), quiet=quiet)
        return Ingested(report=done)

    def align(
        self,
        map_id: str,
        *,
        control_points: PathLike | None = None,
        photos: PathLike | None = None,
        scans: Sequence[str] = (),
        auto: bool = False,
        confirm: Collection[str] = (),
        picks: PathLike | None = None,
        pose: PathLike | None = None,
        image: str | None = None,
        near: tuple[float, ...] | None = None,
        out: PathLike | None = None,
        by_maps: bool = False,
        quiet: bool = False,
    ) -> Aligned:
        """Place a map by control points, by a scan, or by the other maps; exactly one of these is named.

        Args:
            map_id: of the map, or its first letters.
            control_points: OpenDroneMap's gcp_list.txt, as `featuredb register`.
            photos: the map's photos, whose frames are registered to the scans, as `featuredb anchor`.
            scans: ids or their first letters; empty: all around the map.
            auto: place it by the scan if every gate is passed; else frames are only proposed.
            confirm: names of proposed frames by which it is placed.
            picks, pose: file of picked points, or of a rough pose, of the photo `image`.
            near: (latitude, longitude) or (latitude, longitude, radius_m): where a map without a place is
                looked for on the scans.
            out: folder of pictures and report; default: ./anchor-MAP.
            by_maps: a map without a place is placed by the maps that show the same, as `featuredb grow`,
                which takes all that wait.

        Raises:
            InvalidValueError: none or several ways. RegistrationError: photos or scans are missing.
            ControlFileError, MapNotFoundError, StoreError, ConflictError
        """
        check_kind("align: map_id", map_id, str, "the id of a map")
        asked = {"control_points": control_points, "photos": photos, "by_maps": by_maps or None}
        ways = [name for name, value in asked.items() if value is not None]
        if len(ways) != 1:
            raise InvalidValueError(
                "align: expected one of control_points, photos (with scans) and by_maps, found "
                f"{' and '.join(ways) or 'none'}"
            )
        if control_points is not None:
            placed = place_by_control(self.store, map_id, as_path(control_points))
            done = placed.committed is not None
            return Aligned(map_id=placed.map_id, placed=done, report=placed, text=placed.as_text())
        if by_maps:
            map_id = self.store.snapshot().find(map_id).map_id
            grown = self.grow()
            there = {m.map_id for m in self.maps.placed}
            return Aligned(map_id=map_id, placed=map_id in there, report=grown.report, text=str(grown))
        assert photos is not None
        request = AnchorRequest(
            map_id=map_id,
            photos=as_path(photos),
            scan_ids=several(scans),
            out=_path(out),
            auto=auto,
            confirm=several(confirm),
            start=StartFiles(
                pose=_path(pose),
                picks=_path(picks),
                image=image,
                near=None if near is None else Circle.parse(",".join(map(str, several(near)))),
            ),
        )
        with progress_bars(quiet) as progress:
            anchored = anchor(self.store, request, progress)
        return Aligned(
            map_id=anchored.report.map_id,
            placed=anchored.placed,
            report=anchored,
            text=anchoring_text(anchored, self.url),
            page=anchored.page,
        )

    def localise(
        self,
        image: Image,
        *,
        prior: PriorRequest | tuple[float, float, float] | None = None,
        camera: CameraRequest | Camera | None = None,
        exif_prior: bool = True,
        maps: Sequence[str] | None = None,
    ) -> PhotoAnswer:
        """Where was this photo taken? The maps are indexed with the first call, and kept.

        Args:
            image: path or bytes of an image file, or pixels (h, w) or (h, w, 3) uint8, red first.
            prior: latitude, longitude (WGS84 degrees), standard deviation (m); believed as stated.
            camera: intrinsics; exact unless a CameraRequest gives sigmas.
            exif_prior: the position in the photo's EXIF settles what is ambiguous, where `prior` is None.
            maps: ask only the map, or maps, of these ids; one without a place answers in its own frame.

        Raises:
            ImageError: no usable image. InvalidValueError: a prior or camera that is none.
            RequestError: a camera or maps that do not fit.
        """
        return self._asker.ask(
            image,
            prior=prior,
            camera=camera,
            exif_prior=exif_prior,
            maps=None if maps is None else several(maps),
        )

    def track(
        self,
        film: PathLike,
        *,
        out: PathLike | Sequence[PathLike] = (),
        overlay: PathLike | None = None,
        by: FilmBy = "map",
        maps: Sequence[str] | None = None,
        scans: Sequence[str] | None = None,
        pose: PathLike | None = None,
        camera: Camera | None = None,
        prior: GeoPrior | None = None,
        options: TrackVideoOptions | None = None,
    ) -> FilmTrack:
        """The pose of every frame of a film, or that it is lost; as `featuredb track`.

        Args:
            film: a file, a folder of pictures, or an address.
            out: trajectory, or several, to write, by their suffix: .csv, .tum, .geojson, .kml, .json.
            overlay: an mp4 with the track drawn over the film.
            by: maps, a scan, or both. maps, scans: ids; None: all.
            pose: file of the first frame's rough pose. prior: where the film begins.
            camera: intrinsics of the upright frames.

        Raises:
            VideoError: no film. InvalidValueError: what was asked contradicts itself.
            StoreError, RegistrationError, ScanNotFoundError
        """
        check_kind("track: prior", prior, GeoPrior)
        check_kind("track: camera", camera, Camera)
        check_kind("track: options", options, TrackVideoOptions)
        ground = FilmGround(
            by=by,
            maps=None if maps is None else several(maps),
            scans=None if scans is None else several(scans),
            pose_file=_path(pose),
        )
        return FilmTrack(
            film=track_film(
                self.store,
                film,
                out=[as_path(file) for file in several(out)],
                overlay=_path(overlay),
                ground=ground,
                camera=camera,
                prior=prior,
                options=options,
            )
        )

    def sql(self, query: str, *, as_of: int | datetime | None = None) -> SqlTable:
        """All rows of one reading statement; `.df()` and `.arrow()` give them (docs/sql.md).

        Raises:
            StoreError: not one SELECT, or DuckDB refuses it. SnapshotNotFoundError: no such version.
        """
        with SqlSession(self.store.snapshot(as_of), self.store) as session:
            return session.table(query)

    def export(
        self,
        out: PathLike,
        format: str,
        *,
        selection: Selection | None = None,
        as_of: int | datetime | None = None,
        **options: Any,
    ) -> ExportedMaps:
        """Write maps for other systems, whole or not at all; as `featuredb export`.

        Args:
            out: file or folder to be made. format: as in `featuredb export --help`.
            selection: which maps; None: every active one.
            options: `text` (colmap), `photos` (exif), `with_lidar` (dataset).

        Raises:
            ExportError: an unknown format, or `out` is there already. MissingExtraError
        """
        check_kind("export: selection", selection, Selection)
        return export_maps(self.store, as_path(out), format, selection or Selection(), as_of=as_of, **options)

    def grow(self, options: GrowingOptions | None = None, *, quiet: bool = False) -> Grown:
        """Let contributed photos become maps, and maps without a place find theirs; as `featuredb grow`.

        Raises:
            StoreError, ConflictError, IngestError
        """
        check_kind("grow: options", options, GrowingOptions)
        with progress_bars(quiet) as progress:
            return Grown(report=grow_candidates(self.store, options, progress))


def open_database(
    url: PathLike, *, create: bool = False, storage_options: Mapping[str, str] | None = None
) -> FeatureDatabase:
    """See `featuredb.open`."""
    if not isinstance(url, str | Path):
        raise InvalidValueError(f"open: expected a folder or an address in an object store, found {url!r}")
    if not create:
        return FeatureDatabase(Database.open(url, storage_options=storage_options))
    check_place(Database(str(url), storage_options).url)
    return FeatureDatabase(Database.create(url, storage_options=storage_options))


def _path(path: PathLike | None) -> Path | None:
    return None if path is None else as_path(path)
