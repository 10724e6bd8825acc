"""The rows: what README and docs claim, and the command that measures each claim."""

from typing import Any

from tools.scoreboard.row import Limit, Row

_HELD_OUT = ("DJI_0020.JPG", "DJI_0025.JPG", "DJI_0030.JPG", "DJI_0033.JPG")
_BRIGHTON = "{data}/brighton/images"
_SCAN = "{data}/brighton/model.laz"
_OUT = ("--json", "{work}/figures.json")
_ERRORS = {name: name for name in ("asked", "answered", "median_m", "largest_m", "median_deg", "largest_deg")}
_ANSWERS = "{answered} of {asked} answered, median {median_m:.2f} m and {median_deg:.2f} degrees"


def _same(*names: str) -> dict[str, str]:
    return {name: name for name in names}


def _portions(photos: str, cut: str, minutes: float) -> Row:
    return Row(
        name=f"{photos.split('/')[0]}-portions-{cut}",
        group="real",
        form="full",
        claim=f"`{photos.split('/')[0]}` in three portions ({cut}), grown and adjusted, against all at once",
        commands=(
            (
                *("tools.growth_portions", "--photos", f"{{data}}/{photos}", "--cut", cut, "--adjust"),
                *("--work", "{work}/cache", *_OUT),
            ),
        ),
        figures=_same("photos", "joint", "grown", "missing", "median_m", "largest_m"),
        text="{grown} of {joint}, median {median_m:.3f} m, largest {largest_m:.3f} m",
        limits=(Limit(figure="missing", most=0), Limit(figure="median_m", most=0.3)),
        needs=(photos,),
        minutes=minutes,
    )


def _sequence(photos: str, median_m: float, minutes: float) -> Row:
    name = photos.split("/")[0]
    return Row(
        name=f"{name}-as-film",
        group="real",
        form="full",
        claim=f"`{name}`: every second photo is a map, all are played as a film and tracked",
        commands=(("tools.real_sequence", "--photos", f"{{data}}/{photos}", "--work", "{work}/maps", *_OUT),),
        figures=_same("frames", "lost", "median_m", "largest_m", "unknown"),
        text="{lost} of {frames} lost, median {median_m:.3f} m, largest {largest_m:.3f} m",
        limits=(Limit(figure="median_m", most=median_m), Limit(figure="largest_m", most=1.0)),
        needs=(photos,),
        minutes=minutes,
    )


def _made(name: str, claim: str, words: tuple[str, ...], need: str, least: int, **more: Any) -> Row:
    return Row(
        name=name,
        group="real",
        form="full",
        claim=claim,
        commands=(("tools.made_maps", *words, "--work", "{work}/maps", *_OUT),),
        figures=_same("photos", "largest", "mapped", "maps", "placed"),
        text="{largest} in the largest of {maps} maps, {mapped} in all",
        limits=(Limit(figure="largest", least=least),),
        needs=(need,),
        **more,
    )


_REAL = (
    Row(
        name="brighton-held-out",
        group="real",
        form="quick",
        claim="`brighton`: 14 of 18 photos become a map from a cold start; the 4 others over Zenoh, "
        "against a map of all 18",
        commands=(("tools.real_photos", "--photos", _BRIGHTON, "--held-out", *_HELD_OUT, *_OUT),),
        figures=_ERRORS | _same("usable", "registered", "ingest_s"),
        text="{registered} of {usable} in {ingest_s:.0f} s; " + _ANSWERS,
        limits=(
            Limit(figure="registered", least=14),
            Limit(figure="answered", least=4),
            Limit(figure="largest_m", most=1.0),
            Limit(figure="largest_deg", most=0.5),
        ),
        needs=("brighton/images",),
        readme=True,
        minutes=3,
    ),
    Row(
        name="brighton-on-scan",
        group="real",
        form="quick",
        claim="`brighton` anchored on its scan without a person; the 4 others over Zenoh, against poses that "
        "the scan alone gives",
        commands=(
            (
                *("tools.anchor_brighton", "--photos", _BRIGHTON, "--scan", _SCAN),
                *("--poses", "{cache}/brighton-poses.json", "--held-out", *_HELD_OUT, *_OUT),
            ),
        ),
        figures=_ERRORS | _same("before_median_m"),
        text=_ANSWERS + " (by GPS {before_median_m:.1f} m)",
        limits=(
            Limit(figure="answered", least=4),
            Limit(figure="median_m", most=0.30),
            Limit(figure="median_deg", most=0.25),
        ),
        needs=("brighton/images", "brighton/model.laz"),
        readme=True,
        minutes=6,
    ),
    Row(
        name="lewis-held-out",
        group="real",
        form="full",
        claim="`lewis`: every fifth of 55 oblique photos is held out, against a map of all",
        commands=(("tools.real_photos", "--photos", "{data}/lewis/images", *_OUT),),
        figures=_ERRORS | _same("usable", "registered", "ingest_s"),
        text="{registered} of {usable} in {ingest_s:.0f} s; " + _ANSWERS,
        limits=(Limit(figure="registered", least=40), Limit(figure="median_m", most=1.0)),
        needs=("lewis/images",),
        minutes=12,
    ),
    _sequence("brighton/images", 0.3, 3),
    _sequence("lewis/images", 0.4, 15),
    Row(
        name="autzen-windows",
        group="real",
        form="full",
        claim="`autzen`: windows of a real ortho image registered to airborne intensity, priors off by 20 m "
        "and 5 degrees",
        commands=(
            (
                *("tools.autzen_windows", "{data}/autzen/stadium.laz", "{data}/autzen/stadium_ortho.tif"),
                *("--photos", _BRIGHTON, "{data}/lewis/images", "--seed", "7", *_OUT),
            ),
        ),
        figures=_same("structured", "close", "rate", "largest_m", "wrong", "foreign", "foreign_accepted"),
        text="{close} of {structured} within 1.5 m, largest of an accepted one {largest_m:.1f} m; "
        "{foreign_accepted} of {foreign} of other places accepted",
        limits=(
            Limit(figure="rate", least=0.75),
            Limit(figure="wrong", most=0),
            Limit(figure="foreign_accepted", most=0),
        ),
        needs=("autzen", "brighton/images", "lewis/images"),
        readme=True,
        minutes=40,
    ),
    Row(
        name="brighton-by-picks",
        group="real",
        form="full",
        claim="`brighton` without GPS: a map of 14 photos, placed on the scan by six picks (3 px) in one; "
        "20 draws, the 4 others asked of each",
        commands=(
            (
                *("tools.unplaced_brighton", "--photos", _BRIGHTON, "--scan", _SCAN),
                *("--poses", "{cache}/brighton-poses.json", *_OUT),
            ),
        ),
        figures=_same(
            *("maps", "largest", "draws", "placed", "refused", "wrong"),
            *("median_m", "worst_m", "median_deg", "worst_deg"),
        ),
        text="{placed} of {draws} placed, {wrong} wrong; median {median_m:.2f} m and "
        "{median_deg:.2f} degrees, worst draw {worst_m:.2f} m",
        limits=(
            Limit(figure="maps", least=1, most=1),
            Limit(figure="largest", least=14),
            Limit(figure="refused", most=2),
            Limit(figure="wrong", most=0),
            Limit(figure="median_m", most=0.25),
            Limit(figure="median_deg", most=0.25),
        ),
        needs=("brighton/images", "brighton/model.laz"),
        readme=True,
        minutes=40,
    ),
    _made(
        *("karma-map", "`karma.mp4`, 12 s by a drone, becomes a map"),
        *(("--film", "{data}/video/karma.mp4"), "video/karma.mp4", 6),
        minutes=3,
    ),
    _made(
        *("reichstag-map", "`reichstag`: 74 photos of one landmark by many people become a map"),
        *(("--photos", "{data}/reichstag/images"), "reichstag/images", 60),
        minutes=30,
    ),
    _made(
        *("sacre_coeur-map", "`sacre_coeur`: 10 photos by strangers, no EXIF, become a map"),
        *(("--photos", "{data}/sacre_coeur/mapping"), "sacre_coeur/mapping", 9),
        minutes=3,
    ),
    _made(
        *("strecha-map", "`strecha`: 11 photos of a fountain without positions become a map"),
        *(("--photos", "{data}/strecha/fountain-P11"), "strecha/fountain-P11", 11),
        minutes=3,
    ),
    _portions("brighton/images", "interleaved", 4),
    _portions("brighton/images", "consecutive", 4),
    _portions("lewis/images", "consecutive", 20),
    _portions("copr/images", "consecutive", 15),
    _portions("sacre_coeur/mapping", "interleaved", 4),
)

_TRACKED = ("frames", "lost", "invented", "mean_m", "largest_m", "first_m", "last_m", "rate_hz")


def _track(film: str, on: str, size: str, frames: int, mean_m: float, minutes: float) -> Row:
    return Row(
        name=f"track-{film}-{on}-{size}-{frames}",
        group="simulated",
        form="quick" if frames < 500 else "full",
        claim=f"a {film} film of {frames} frames over the town ({size}), tracked on "
        + {"map": "its map", "scan": "its scan alone", "both": "map and scan"}[on],
        commands=(
            (
                *("tools.track_evaluation", "--out", "{work}", "--inputs", "{cache}", "--size", size),
                *("--frames", str(frames), "--films", film, "--on", on),
            ),
        ),
        json="{work}/track.json",
        figures={name: f"figures.{film}.{name}" for name in _TRACKED},
        text="{lost} of {frames} lost, {invented} invented, mean {mean_m:.3f} m, largest {largest_m:.2f} m; "
        "{rate_hz:.0f} frames/s",
        limits=(
            Limit(figure="mean_m", most=mean_m),
            Limit(figure="largest_m", most=1.0),
            Limit(figure="invented", most=0),
        ),
        readme=(film, on, frames) == ("smooth", "map", 1200),
        minutes=minutes,
    )


def _growth(name: str, claim: str, words: tuple[str, ...], document: str, minutes: float) -> Row:
    return Row(
        name=name,
        group="simulated",
        form="full",
        claim=claim,
        commands=((*words, "--out", "{work}"),),
        json=f"{{work}}/{document}.json",
        figures=_same("failed", "summary"),
        text="{summary}",
        limits=(Limit(figure="failed", most=0),),
        minutes=minutes,
    )


_SIMULATED = (
    Row(
        name="town-on-scan",
        group="simulated",
        form="quick",
        claim="24 photos with a drone's GPS, placed by an airborne scan with intensity only; another town's "
        "scan is refused",
        commands=(("tools.anchor_simworld", "--work", "{work}/town", *_OUT),),
        figures=_same(
            *("placed", "other_placed", "gps_cameras_m", "scan_cameras_m", "scan_cameras_deg"),
            *("scan_queries", "scan_answered", "scan_queries_m", "scan_queries_largest_m"),
        ),
        text="cameras {gps_cameras_m:.1f} m off by GPS, {scan_cameras_m:.3f} m by the scan (medians); "
        "{scan_answered} of {scan_queries} queries, median {scan_queries_m:.3f} m, "
        "largest {scan_queries_largest_m:.2f} m",
        limits=(
            Limit(figure="placed", least=1),
            Limit(figure="other_placed", most=0),
            Limit(figure="scan_cameras_m", most=0.10),
            Limit(figure="scan_queries_largest_m", most=0.5),
        ),
        readme=True,
        minutes=4,
    ),
    Row(
        name="town-held-out",
        group="simulated",
        form="full",
        claim="60 held-out drone photos of the town, survey-grade tags; photos that show no mapped place",
        commands=(("tools.simulated_evaluation", "--out", "{work}/town", "--seed", "3", *_OUT),),
        figures=_same(
            *("asked", "answered", "within", "median_m", "median_deg", "wrong", "negatives"),
            *("negatives_answered", "street", "street_answered"),
        )
        | {
            "inside_horizontal": "coverage.survey receiver.horizontal",
            "inside_orientation": "coverage.survey receiver.orientation",
        },
        text="{answered} of {asked}, {within:.1%} within 0.25 m and 0.3 degrees, median {median_m:.3f} m; "
        "{negatives_answered} of {negatives} others answered, {street_answered} of {street} from the street",
        limits=(
            Limit(figure="within", least=0.95),
            Limit(figure="wrong", most=0),
            Limit(figure="negatives_answered", most=0),
        ),
        readme=True,
        minutes=25,
    ),
    _track("smooth", "map", "short", 150, 0.10, 3),
    _track("cut", "map", "short", 150, 0.10, 3),
    _track("smooth", "map", "short", 1200, 0.10, 15),
    _track("jerky", "map", "short", 1200, 0.25, 15),
    _track("smooth", "scan", "short", 1200, 0.20, 15),
    Row(
        name="film-map",
        group="simulated",
        form="full",
        claim="a film of 1,200 frames with telemetry becomes a map that is placed on the scan",
        commands=(("tools.video_map", "--out", "{work}"),),
        json="{work}/video_map.json",
        figures={
            name: f"figures.{name}"
            for name in ("keyframes", "keyframes_m", "keyframes_largest_m", "placed", "made_s", "anchored_s")
        },
        text="{keyframes} keyframes, median {keyframes_m:.3f} m, largest {keyframes_largest_m:.3f} m; "
        "{made_s:.0f} s, and {anchored_s:.0f} s for placing",
        limits=(Limit(figure="placed", least=1), Limit(figure="keyframes_largest_m", most=0.10)),
        minutes=20,
    ),
    Row(
        name="paper-film",
        group="simulated",
        form="full",
        claim="a film of 1,200 frames without telemetry and an intensity-only scan: placed by six picks in "
        "one frame, tracked from end to end",
        commands=(("tools.paper", "--out", "{work}", "--inputs", "{cache}", "--only", "film"),),
        json="{work}/paper.json",
        figures=_same("placed", "lost", "mean_m", "first_m", "last_m", "largest_m", "rate_hz", "made_s"),
        text="mean {mean_m:.3f} m (first quarter {first_m:.3f}, last {last_m:.3f}), {lost} lost, "
        "{rate_hz:.0f} frames/s",
        limits=(Limit(figure="placed", least=1), Limit(figure="mean_m", most=0.10)),
        readme=True,
        minutes=15,
    ),
    _growth(
        *("growth-community", "300 photos of the town by twelve people: growth finds their places"),
        *(("tools.growth_community", "--size", "full"), "community", 240),
    ),
    _growth(
        *("growth-poison", "210 photos of look-alikes, liars and forgers: nothing wrong is promoted"),
        *(("tools.growth_poison", "--size", "full", "--poison", "all together"), "poison", 180),
    ),
    _growth(
        *("growth-walk", "a walk of 25 steps from one anchor by contributed photos alone: the bound is true"),
        *(("tools.growth_walk", "--size", "full", "--budget", "2.0"), "walk", 180),
    ),
)

_STUDIES = Row(
    name="studies",
    group="simulated",
    form="full",
    claim="the studies among the tests: rates of covariances, kills at each stage, real control points",
    commands=(("tools.evaluations", *_OUT),),
    figures=_same("tests", "failed", "skipped"),
    text="{failed} of {tests} failed, {skipped} skipped",
    limits=(Limit(figure="failed", most=0), Limit(figure="tests", least=20)),
    minutes=15,
)
_SPEED = (
    Row(
        name="query-time",
        group="speed",
        form="quick",
        claim="one 12-megapixel photo of `brighton` with its GPS over Zenoh (medians)",
        commands=(
            ("featuredb.cli", "ingest", "photos", "{work}/db", _BRIGHTON, "--quiet"),
            (
                *("tools.query_benchmark", "{work}/db", f"{_BRIGHTON}/DJI_0020.JPG"),
                *(f"{_BRIGHTON}/DJI_0033.JPG", "--photos", _BRIGHTON, "--pycolmap-images", "0", *_OUT),
            ),
        ),
        figures=_same("wall_ms", "in_process_ms", "transport_ms", "asked", "localised"),
        text="{wall_ms:.0f} ms, of which transport {transport_ms:.1f} ms",
        limits=(Limit(figure="wall_ms", most=1000), Limit(figure="transport_ms", most=10)),
        needs=("brighton/images",),
        readme=True,
        minutes=2,
    ),
    Row(
        name="scan-memory",
        group="speed",
        form="full",
        claim="100 million points added by `lidar add`",
        commands=(("tools.lidar_memory", "--points", "100000000", "--folder", "{work}/scan", *_OUT),),
        figures=_same("peak_tree_mib", "cpu_seconds", "points_per_cpu_second"),
        text="{peak_tree_mib:.0f} MiB at the peak, {cpu_seconds:.0f} s of a core",
        limits=(Limit(figure="peak_tree_mib", most=2048),),
        readme=True,
        minutes=15,
    ),
)

ROWS: tuple[Row, ...] = (*_REAL, *_SIMULATED, _STUDIES, *_SPEED)
