"""Rows of the simulated town."""

from tools.scoreboard.row import Limit, Row
from tools.scoreboard.words import OUT, same

_SIGMAS, _KINDS = ("2cm", "50cm", "300cm"), ("position", "orientation")
_TRACKED = (
    *("frames", "lost", "invented", "mean_m", "largest_m", "first_m", "last_m", "rate_hz"),
    *("position_95", "orientation_95", "squared", "few_position_95", "few_orientation_95", "few_squared"),
)


def _track(film: str, on: str, size: str, frames: int, mean_m: float, minutes: float) -> Row:
    return Row(
        name=f"track-{film}-{on}-{size}-{frames}",
        group="simulated",
        form="full",
        claim=f"a {film} film of {frames} frames over the town ({size}), tracked on "
        + {"map": "its map", "scan": "its scan alone"}[on],
        commands=(
            (
                *("tools.track_evaluation", "--out", "{work}", "--inputs", "{cache}", "--size", size),
                *("--frames", str(frames), "--films", film, "--on", on),
            ),
        ),
        json="{work}/track.json",
        figures={name: f"{film}.{name}" for name in _TRACKED},
        text="{lost} of {frames} lost, {invented} invented, mean {mean_m:.3f} m, largest {largest_m:.2f} m; "
        "{rate_hz:.0f} frames/s; inside 95 %: {position_95:.0%} and {orientation_95:.0%}, with fewest "
        "landmarks {few_position_95:.0%} and {few_orientation_95:.0%} (squared error {few_squared:.1f}; 3 is "
        "right)",
        limits=(
            Limit(figure="mean_m", most=mean_m),
            Limit(figure="few_position_95", least=0.90),
            Limit(figure="few_orientation_95", least=0.90),
            Limit(figure="largest_m", most=1.0),
            Limit(figure="invented", most=0),
        ),
        minutes=minutes,
    )


def _films(seed: int) -> Row:
    return Row(
        name=f"community-films-{seed}",
        group="simulated",
        form="full",
        claim="a folder of six films by strangers (cuts, titles, a zoom, logos, another town, bad "
        "compression): maps of the place, placed by six picks in one frame, every film tracked; "
        f"draw {seed}",
        commands=(
            (
                "tools.community_films",
                "--work",
                "{work}/films",
                "--inputs",
                "{cache}",
                "--seed",
                str(seed),
                *OUT,
            ),
        ),
        figures=same("placed", "largest_m"),
        text="{shots_in_maps} of {place_shots} shots in {place_maps} maps of the place, {foreign_in_maps} "
        "keyframes of elsewhere in them; {tracked_share:.1%} of {place_frames} frames tracked, "
        "{inside_share:.1%} inside their bounds, median {median_m:.3f} m",
        limits=(
            Limit(figure="shots_in_maps", least=8),
            Limit(figure="foreign_in_maps", most=0),
            Limit(figure="lost_without_reason", most=0),
            Limit(figure="inside_share", least=0.9),
            Limit(figure="foreign_tracked", most=0),
        ),
        minutes=45,
    )


def _growth(name: str, claim: str, words: tuple[str, ...], document: str, minutes: float) -> Row:
    return Row(
        name=name,
        group="simulated",
        form="full",
        claim=claim,
        commands=((*words, "--out", "{work}"),),
        json=f"{{work}}/{document}.json",
        text="{summary}",
        limits=(Limit(figure="failed", most=0),),
        minutes=minutes,
    )


SIMULATED: tuple[Row, ...] = (
    Row(
        name="town-on-scan",
        group="simulated",
        form="quick",
        claim="24 photos with a drone's GPS, placed by an airborne scan with intensity only; another town's "
        "scan is refused",
        commands=(("tools.anchor_simworld", "--work", "{work}/town", "--inputs", "{cache}", *OUT),),
        figures=same("scan_cameras_deg"),
        text="cameras {gps_cameras_m:.1f} m off by GPS, {scan_cameras_m:.3f} m by the scan (medians); "
        "{scan_answered} of {scan_queries} queries, median {scan_queries_m:.3f} m, "
        "largest {scan_queries_largest_m:.2f} m",
        limits=(
            Limit(figure="placed", least=1),
            Limit(figure="other_placed", most=0),
            Limit(figure="scan_cameras_m", most=0.10),
            Limit(figure="scan_queries_largest_m", most=0.5),
        ),
        minutes=4,
    ),
    Row(
        name="town-located-pixels",
        group="simulated",
        form="full",
        claim="places of pixels that show what stands still, on an airborne scan: from answers to held-out "
        "photos, and from poses and lenses drawn as the answers' covariances say, which test the bounds",
        commands=(("tools.locate_pixels", "--work", "{work}/town", "--inputs", "{cache}", *OUT),),
        figures=same("answered_95", "drawn_edges", "drawn_edge_95"),
        text="answers: median {answered_median_m:.3f} m, 95 % off edges within {answered_clear_95_m:.3f} m; "
        "drawn: {drawn_68:.0%} and {drawn_95:.1%} inside 68 and 95 % bounds, {drawn_edge_95:.0%} of the "
        "{drawn_edges:.0%} that say that they are at an edge; {refused} refused beside {located}",
        limits=(
            Limit(figure="answered_median_m", most=0.05),
            Limit(figure="drawn_68", least=0.63, most=0.73),
            Limit(figure="drawn_95", least=0.90),
        ),
        minutes=6,
    ),
    Row(
        name="lens-draws",
        group="simulated",
        form="full",
        claim="900 flights with lenses that nobody knows, positions of 0.02, 0.5 and 3 m; 20 answers each: "
        "errors inside the bounds of position and orientation",
        commands=(("tools.lens_draws", "--draws", "300", *OUT),),
        text="; ".join(
            f"{sigma}: position {{position_68_{sigma}:.0%}} and {{position_95_{sigma}:.1%}}, "
            f"orientation {{orientation_68_{sigma}:.0%}} and {{orientation_95_{sigma}:.1%}} "
            "inside 68 and 95 % bounds"
            for sigma in _SIGMAS
        )
        + "; of {level:.0f} level flights cameras are off in height by {bent_m:.3f} m, nine of ten by at "
        "most {bent_90_m:.3f} m",
        limits=tuple(
            limit
            for sigma in _SIGMAS
            for kind in _KINDS
            for limit in (
                Limit(figure=f"{kind}_68_{sigma}", least=0.63, most=0.73),
                Limit(figure=f"{kind}_95_{sigma}", least=0.90),
                Limit(figure=f"{kind}_far_{sigma}", most=0),
            )
        ),
        minutes=15,
    ),
    Row(
        name="rtk-placed",
        group="simulated",
        form="full",
        claim="18 photos with positions good to 2 cm, said by XMP of DJI, of Autel and of Pix4D (senseFly, "
        "Parrot), by EXIF, by a table and by geo.txt; then heights 20 m off, against control points",
        commands=(("tools.rtk_placed", "--work", "{work}/rtk", "--inputs", "{cache}", *OUT),),
        text="{active} of 6 maps answer, worst median {worst_m:.3f} m, place known to {worst_sigma_m:.3f} m; "
        "heights said to be {told_m:.2f} m off, {told_wrongly} times wrongly",
        limits=(
            Limit(figure="active", least=6),
            Limit(figure="worst_m", most=0.03),
            Limit(figure="worst_sigma_m", most=0.04),
            Limit(figure="told_m", least=19.0, most=21.0),
            Limit(figure="told_wrongly", most=0),
        ),
        minutes=6,
    ),
    Row(
        name="rolling-shutter",
        group="simulated",
        form="full",
        claim="photos of four simulated flights, smooth and jerky, with rows read out over 30 ms, placed by "
        "a drone's receiver and by RTK: what answers is inside 99.9 %, and the rolling shutter is named",
        commands=(("tools.rolling_shutter", "--work", "{work}/rolling", "--inputs", "{cache}", *OUT),),
        text="{active} of {flights} answer, {outside} of them outside (worst squared error "
        "{worst_squared:.1f}; 16.3 is 99.9 %); {held_back} do not; {unnamed} of all do not name it",
        limits=(Limit(figure="outside", most=0), Limit(figure="unnamed", most=0)),
        minutes=8,
    ),
    Row(
        name="town-held-out",
        group="simulated",
        form="full",
        claim="60 held-out drone photos of the town, survey-grade tags; photos that show no mapped place",
        commands=(("tools.simulated_evaluation", "--out", "{work}/town", "--seed", "3", *OUT),),
        figures=same("median_deg")
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
            # 68 % within two standard deviations of the count of 60.
            Limit(figure="inside_horizontal", least=0.56, most=0.80),
            Limit(figure="inside_orientation", least=0.56, most=0.80),
        ),
        readme=True,
        minutes=25,
    ),
    Row(
        name="track-short",
        group="simulated",
        form="quick",
        claim="films of 150 frames over the town, smooth and with a cut to another town, tracked on its map; "
        "the marks of a GeoJSON layer that `draw` lays over them, against where they belong",
        commands=(
            (
                *("tools.track_evaluation", "--out", "{work}", "--inputs", "{cache}", "--size", "short"),
                *("--frames", "150", "--films", "smooth", "cut", "--on", "map", "--draw"),
            ),
        ),
        json="{work}/track.json",
        figures={
            f"{film}_{name}": f"{film}.{name}"
            for film in ("smooth", "cut")
            for name in ("frames", "lost", "invented", "mean_m", "largest_m", "rate_hz", "found_s")
        }
        | {
            f"{film}_layer_{name}": f"{film}_layer.{name}"
            for film in ("smooth", "cut")
            for name in ("frames", "marks", "stray", "median_px", "largest_px")
        },
        text="smooth: {smooth_lost} lost, mean {smooth_mean_m:.3f} m, {smooth_rate_hz:.0f} frames/s; "
        "cut: {cut_lost} lost, mean {cut_mean_m:.3f} m, {cut_invented} invented; {smooth_layer_marks} marks "
        "in {smooth_layer_frames} smooth frames: median {smooth_layer_median_px:.1f} px, largest "
        "{smooth_layer_largest_px:.1f} px; {cut_layer_marks} in {cut_layer_frames} with the cut: "
        "{cut_layer_median_px:.1f} px, {cut_layer_largest_px:.1f} px",
        limits=(
            Limit(figure="smooth_lost", most=0),
            Limit(figure="smooth_mean_m", most=0.10),
            Limit(figure="cut_mean_m", most=0.10),
            Limit(figure="cut_largest_m", most=1.0),
            Limit(figure="cut_invented", most=0),
            Limit(figure="cut_found_s", most=1.0),
            *(Limit(figure=f"{film}_layer_largest_px", most=2.0) for film in ("smooth", "cut")),
            *(Limit(figure=f"{film}_layer_stray", most=0) for film in ("smooth", "cut")),
            Limit(figure="smooth_layer_frames", least=150),
        ),
        minutes=4,
    ),
    _track("jerky", "map", "short", 600, 0.25, 10),
    _track("smooth", "scan", "short", 600, 0.20, 10),
    Row(
        name="film-map",
        group="simulated",
        form="full",
        claim="a film of 1,200 frames with telemetry becomes a map that is placed on the scan",
        commands=(("tools.video_map", "--out", "{work}"),),
        json="{work}/video_map.json",
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
        "one frame, tracked from end to end (paper: 0.4 m, 29.7 frames/s with a GPU; a frame 15 to 30 s, "
        "structure projection 1 s)",
        commands=(("tools.paper", "--out", "{work}", "--inputs", "{cache}"),),
        json="{work}/paper.json",
        figures=same("largest_m", "made_s"),
        text="mean {mean_m:.3f} m (first quarter {first_m:.3f}, last {last_m:.3f}; from the map's adjusted "
        "keyframes {adjusted_m:.3f}), {lost} lost, {rate_hz:.0f} frames/s; a frame {frame_s:.0f} s, "
        "structure projection {projection_s:.1f} s",
        limits=(
            Limit(figure="placed", least=1),
            Limit(figure="mean_m", most=0.10),
            Limit(figure="last_over_first", most=1.3),
            Limit(figure="lost", most=12),
        ),
        resumes=True,
        minutes=25,
    ),
    *(_films(seed) for seed in (1, 2)),
    _growth(
        *("growth-community", "48 photos of a small town by twelve people: growth finds their places"),
        *(("tools.growth_community", "--size", "short"), "community", 25),
    ),
    _growth(
        *("growth-poison", "look-alikes, liars and forgers in a small town: nothing wrong is promoted"),
        *(("tools.growth_poison", "--size", "short", "--poison", "all together"), "poison", 25),
    ),
    _growth(
        *("growth-walk", "a walk of 270 m from one anchor by contributed photos alone: the bound is true"),
        *(("tools.growth_walk", "--size", "short"), "walk", 25),
    ),
    Row(
        name="studies",
        group="simulated",
        form="full",
        claim="the studies among the tests: rates of covariances, kills at each stage, real control points",
        commands=(("tools.evaluations", *OUT),),
        text="{failed} of {tests} failed, {skipped} skipped",
        limits=(Limit(figure="failed", most=0), Limit(figure="tests", least=20)),
        minutes=15,
    ),
)
