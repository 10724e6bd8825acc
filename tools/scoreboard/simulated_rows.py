"""Rows of the simulated town."""

from functools import partial

from tools.scoreboard.row import Row
from tools.scoreboard.words import OUT

_row = partial(Row, group="simulated")
_SIGMAS = ("2cm", "50cm", "300cm")


def _track(film: str, on: str, mean_m: float) -> Row:
    return _row(
        name=f"track-{film}-{on}-short-600",
        claim=f"a {film} film of 600 frames over the town, tracked on its {on} alone",
        commands=f"tools.track_evaluation --work {{work}} --inputs {{cache}} --frames 600 --films {film} "
        f"--on {on} {OUT}",
        figures="first_m last_m squared",
        text="{lost} of {frames} lost, {invented} invented, mean {mean_m:.3f} m, largest {largest_m:.2f} m; "
        "{rate_hz:.0f} frames/s; inside 95 %: {position_95:.0%} and {orientation_95:.0%}, with fewest "
        "landmarks {few_position_95:.0%} and {few_orientation_95:.0%} (squared error {few_squared:.1f}; 3 is "
        "right)",
        limits=f"mean_m <= {mean_m:g}, 0.9 <= few_position_95, 0.9 <= few_orientation_95, largest_m <= 1, "
        "invented <= 0",
        minutes=10,
    )


def _films(seed: int) -> Row:
    return _row(
        name=f"community-films-{seed}",
        claim="a folder of six films by strangers (cuts, titles, a zoom, logos, another town, bad "
        "compression): maps of the place, placed by six picks in one frame, every film tracked; "
        f"draw {seed}",
        commands=f"tools.community_films --work {{work}}/films --inputs {{cache}} --seed {seed} {OUT}",
        figures="placed largest_m",
        text="{shots_in_maps} of {place_shots} shots in {place_maps} maps of the place, {foreign_in_maps} "
        "keyframes of elsewhere in them; {tracked_share:.1%} of {place_frames} frames tracked, "
        "{inside_share:.1%} inside their bounds, median {median_m:.3f} m",
        limits="8 <= shots_in_maps, foreign_in_maps <= 0, lost_without_reason <= 0, 0.9 <= inside_share, "
        "foreign_tracked <= 0",
        minutes=45,
    )


def _growth(kind: str, claim: str) -> Row:
    return _row(
        name=f"growth-{kind}",
        claim=claim,
        commands=f"tools.growth_{kind} --work {{work}} {OUT}",
        text="{summary}",
        limits="failed <= 0",
        minutes=25,
    )


SIMULATED: tuple[Row, ...] = (
    _row(
        name="town-on-scan",
        form="quick",
        claim="24 photos with a drone's GPS, placed by an airborne scan with intensity only; another town's "
        "scan is refused",
        commands=f"tools.anchor_simworld --work {{work}}/town --inputs {{cache}} {OUT}",
        figures="scan_cameras_deg",
        text="cameras {gps_cameras_m:.1f} m off by GPS, {scan_cameras_m:.3f} m by the scan (medians); "
        "{scan_answered} of {scan_queries} queries, median {scan_queries_m:.3f} m, "
        "largest {scan_queries_largest_m:.2f} m",
        limits="1 <= placed, other_placed <= 0, scan_cameras_m <= 0.1, scan_queries_largest_m <= 0.5",
        minutes=4,
    ),
    _row(
        name="town-located-pixels",
        claim="places of pixels that show what stands still, on an airborne scan: from answers to held-out "
        "photos, and from poses and lenses drawn as the answers' covariances say, which test the bounds",
        commands=f"tools.anchor_simworld --pixels --work {{work}}/town --inputs {{cache}} {OUT}",
        figures="answered_95 drawn_edges drawn_edge_95",
        text="answers: median {answered_median_m:.3f} m, 95 % off edges within {answered_clear_95_m:.3f} m; "
        "drawn: {drawn_68:.0%} and {drawn_95:.1%} inside 68 and 95 % bounds, {drawn_edge_95:.0%} of the "
        "{drawn_edges:.0%} that say that they are at an edge; {refused} refused beside {located}",
        limits="answered_median_m <= 0.05, 0.63 <= drawn_68 <= 0.73, 0.9 <= drawn_95",
        minutes=6,
    ),
    _row(
        name="lens-draws",
        claim="900 flights with lenses that nobody knows, positions of 0.02, 0.5 and 3 m; 20 answers each: "
        "errors inside the bounds of position and orientation",
        commands=f"tools.lens_draws --draws 300 {OUT}",
        text="; ".join(
            f"{sigma}: position {{position_68_{sigma}:.0%}} and {{position_95_{sigma}:.1%}}, "
            f"orientation {{orientation_68_{sigma}:.0%}} and {{orientation_95_{sigma}:.1%}} "
            "inside 68 and 95 % bounds"
            for sigma in _SIGMAS
        ),
        limits=", ".join(
            f"0.63 <= {kind}_68_{sigma} <= 0.73, 0.9 <= {kind}_95_{sigma}, {kind}_far_{sigma} <= 0"
            for sigma in _SIGMAS
            for kind in ("position", "orientation")
        ),
        minutes=15,
    ),
    _row(
        name="rtk-placed",
        claim="18 photos with positions good to 2 cm, said by XMP of DJI, of Autel and of Pix4D (senseFly, "
        "Parrot), by EXIF, by a table and by geo.txt; then heights 20 m off, against control points",
        commands=f"tools.rtk_placed --work {{work}}/rtk --inputs {{cache}} {OUT}",
        text="{active} of 6 maps answer, worst median {worst_m:.3f} m, place known to {worst_sigma_m:.3f} m; "
        "heights said to be {told_m:.2f} m off, {told_wrongly} times wrongly",
        limits="6 <= active, worst_m <= 0.03, worst_sigma_m <= 0.04, 19 <= told_m <= 21, told_wrongly <= 0",
        minutes=6,
    ),
    _row(
        name="rolling-shutter",
        claim="photos of four simulated flights, smooth and jerky, with rows read out over 30 ms, placed by "
        "a drone's receiver and by RTK: what answers is inside 99.9 %, and the rolling shutter is named",
        commands=f"tools.rolling_shutter --work {{work}}/rolling --inputs {{cache}} {OUT}",
        text="{active} of {flights} answer, {outside} of them outside (worst squared error "
        "{worst_squared:.1f}; 16.3 is 99.9 %); {held_back} do not; {unnamed} of all do not name it",
        limits="outside <= 0, unnamed <= 0",
        minutes=8,
    ),
    _row(
        name="town-held-out",
        claim="60 held-out drone photos of the town, survey-grade tags; photos that show no mapped place",
        commands=f"tools.simulated_evaluation --work {{work}}/town --seed 3 {OUT}",
        figures="median_deg",
        text="{answered} of {asked}, {within:.1%} within 0.25 m and 0.3 degrees, median {median_m:.3f} m; "
        "{negatives_answered} of {negatives} others answered, {street_answered} of {street} from the street",
        # Inside: 68 % within two standard deviations of the count of 60.
        limits="0.95 <= within, wrong <= 0, negatives_answered <= 0, 0.56 <= inside_horizontal <= 0.8, "
        "0.56 <= inside_orientation <= 0.8",
        readme=True,
        minutes=25,
    ),
    _row(
        name="track-short",
        form="quick",
        claim="films of 150 frames over the town, smooth and with a cut to another town, tracked on its map; "
        "the marks of a GeoJSON layer that `draw` lays over them, against where they belong",
        commands="tools.track_evaluation --work {work} --inputs {cache} --frames 150 --films smooth cut "
        f"--on map --draw {OUT}",
        figures="smooth_frames smooth_invented smooth_largest_m smooth_found_s cut_frames cut_rate_hz",
        text="smooth: {smooth_lost} lost, mean {smooth_mean_m:.3f} m, {smooth_rate_hz:.0f} frames/s; "
        "cut: {cut_lost} lost, mean {cut_mean_m:.3f} m, {cut_invented} invented; {smooth_layer_marks} marks "
        "in {smooth_layer_frames} smooth frames: median {smooth_layer_median_px:.1f} px, largest "
        "{smooth_layer_largest_px:.1f} px; {cut_layer_marks} in {cut_layer_frames} with the cut: "
        "{cut_layer_median_px:.1f} px, {cut_layer_largest_px:.1f} px",
        limits="smooth_lost <= 0, smooth_mean_m <= 0.1, cut_mean_m <= 0.1, cut_largest_m <= 1, "
        "cut_invented <= 0, cut_found_s <= 1, smooth_layer_largest_px <= 2, cut_layer_largest_px <= 2, "
        "smooth_layer_stray <= 0, cut_layer_stray <= 0, 150 <= smooth_layer_frames",
        minutes=4,
    ),
    _track("jerky", "map", 0.25),
    _track("smooth", "scan", 0.20),
    _row(
        name="frames-on-scan",
        claim="ten towns, scans with intensities alone: photos from 70 m, each from 15 m and 10 degrees off, "
        "one by one; maps of ten photos from 25 m, as far off, together; on another town's scan; mirrored",
        commands=f"tools.frames_on_scan --work {{work}}/towns --inputs {{cache}} {OUT}",
        text="{right_share:.0%} of {tried} single photos within 0.3 m and 0.3 degrees, {singles_wrong} "
        "wrong, {negatives_accepted} of {negatives} registered elsewhere; {placed} of {towns} low maps "
        "placed, median {median_m:.3f} m, largest {largest_m:.2f} m ({alone} of {alone_tried} of their "
        "photos alone); elsewhere {other_placed}, mirrored {mirrored_placed}",
        limits="0.9 <= right_share, singles_wrong <= 0, negatives_accepted <= 0, 8 <= placed, wrong <= 0, "
        "other_placed <= 0, mirrored_placed <= 0",
        resumes=True,
        minutes=120,
    ),
    _row(
        name="street-on-scan",
        claim="ten towns, 60 street photos each by ten people, a third with geotags of 10 m: maps of ten "
        "photos and more placed on scans with intensities alone by fronts and ground; on another town's scan",
        commands=f"tools.street_on_scan --work {{work}}/towns --inputs {{cache}} {OUT}",
        text="{right_share:.0%} of {photos} photos in {maps} maps within 0.5 m and 0.5 degrees, of {placed} "
        "placed {outside} more than a metre outside 99.9 %, median {median_m:.2f} m, largest {largest_m:.2f} "
        "m; elsewhere {elsewhere_placed} of {elsewhere} maps",
        limits="0.6 <= right_share, outside <= 0, elsewhere_placed <= 0",
        resumes=True,
        minutes=120,
    ),
    _row(
        name="film-near",
        claim="a film of 1,200 frames without telemetry, looked for within 250 m of a point 100 m off on a "
        "scan with intensities alone; ten points, and ten on the scan of another town",
        commands=f"tools.film_near --work {{work}}/near --inputs {{cache}} {OUT}",
        text="{here_placed} of {draws} placed, {here_wrong} wrong, cameras median {here_m:.3f} m; on the "
        "other scan: {elsewhere_placed}",
        limits="7 <= here_placed, here_wrong <= 0, elsewhere_placed <= 0",
        resumes=True,
        minutes=40,
    ),
    _row(
        name="paper-film",
        claim="a film of 1,200 frames without telemetry and an intensity-only scan: placed by six picks in "
        "one frame, tracked from end to end (paper: 0.4 m, 29.7 frames/s with a GPU; a frame 15 to 30 s, "
        "structure projection 1 s)",
        commands=f"tools.paper --work {{work}} --inputs {{cache}} {OUT}",
        figures="largest_m made_s",
        text="mean {mean_m:.3f} m (first quarter {first_m:.3f}, last {last_m:.3f}; from the map's adjusted "
        "keyframes {adjusted_m:.3f}), {lost} lost, {rate_hz:.0f} frames/s; a frame {frame_s:.0f} s, "
        "structure projection {projection_s:.1f} s",
        limits="1 <= placed, mean_m <= 0.1, last_over_first <= 1.3, lost <= 12",
        resumes=True,
        minutes=25,
    ),
    *(_films(seed) for seed in (1, 2)),
    _growth("community", "48 photos of a small town by twelve people: growth finds their places"),
    _growth("poison", "look-alikes, liars and forgers in a small town: nothing wrong is promoted"),
    _growth("walk", "a walk of 270 m from one anchor by contributed photos alone: the bound is true"),
    _row(
        name="studies",
        claim="the studies among the tests: rates of covariances, kills at each stage, real control points",
        commands=f"tools.evaluations {OUT}",
        text="{failed} of {tests} failed, {skipped} skipped",
        limits="failed <= 0, 20 <= tests",
        minutes=15,
    ),
)
