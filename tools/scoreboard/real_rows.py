"""Rows of real photos, films and scans."""

from functools import partial
from itertools import product

from tools.scoreboard.row import Form, Row
from tools.scoreboard.words import ANSWERS, BRIGHTON, BRIGHTON_LENS, ERRORS, HELD_OUT, ON_SCAN, OUT, SCAN

_row = partial(Row, group="real")


def _portions(photos: str, cut: str, minutes: float) -> Row:
    return _row(
        name=f"{photos.split('/')[0]}-portions-{cut}",
        claim=f"`{photos.split('/')[0]}` in three portions ({cut}), grown, against all at once",
        commands=f"tools.growth_portions --photos {{data}}/{photos} --cut {cut} --work {{work}}/cache {OUT}",
        text="{grown} of {joint}, median {median_m:.3f} m, largest {largest_m:.3f} m",
        limits="missing <= 0, median_m <= 0.3",
        minutes=minutes,
    )


def _sequence(photos: str, median_m: float, minutes: float) -> Row:
    name = photos.split("/")[0]
    return _row(
        name=f"{name}-as-film",
        claim=f"`{name}`: every second photo is a map, all are played as a film and tracked",
        commands=f"tools.real_photos --as-film --photos {{data}}/{photos} --work {{work}}/maps {OUT}",
        figures="unknown",
        text="{lost} of {frames} lost, median {median_m:.3f} m, largest {largest_m:.3f} m",
        limits=f"median_m <= {median_m:g}, largest_m <= 1",
        minutes=minutes,
    )


def _laser(name: str, photos: int, form: Form, limits: str = "") -> Row:
    return _row(
        name=f"strecha-{name}",
        form=form,
        claim=f"`strecha/{name}`: {photos} photos with exact positions become a map, others are asked, their "
        "camera told and unknown; against a laser scan, beside COLMAP given the true lens",
        commands=f"tools.laser_truth {{data}}/strecha/{name} {OUT}",
        figures="map_reported_deg told_reported_m",
        text="{map_found} photos; map {map_m:.4f} m and {map_deg:.3f} degrees (COLMAP {map_colmap_m:.4f} m), "
        "told {told_m:.4f} m and {told_deg:.3f}, unknown {unknown_m:.4f} m and {unknown_deg:.3f} "
        "(COLMAP {told_colmap_m:.4f} m); worst ratio {worst:.1f}; lens off by {lens_off:.1f} of its sigmas",
        limits=f"{limits}{photos} <= map_found, worst <= 1.5, lens_off <= 1.8",  # 99.9 % of eight parameters
        minutes=1,
    )


_STRIPS = (
    "{KIND_strips:.0f} KIND: with angles {KIND_answer:.0%} answer, turn {KIND_turn_deg:.1f} degrees, inside "
    "68 and 95 % bounds position {KIND_position_68:.0%} and {KIND_position_95:.1%}, orientation "
    "{KIND_orientation_68:.0%} and {KIND_orientation_95:.1%}; without {KIND_without_answer:.0%} answer, turn "
    "{KIND_without_turn_deg:.1f} degrees, inside 95 % {KIND_without_position_95:.1%} and "
    "{KIND_without_orientation_95:.1%}"
)

REAL: tuple[Row, ...] = (
    _row(
        name="mixed-folder",
        claim="eight sets of seven places by many cameras, with positions and without, in one folder",
        commands="tools.made_maps "
        + " ".join(
            f"{name}={{data}}/{name}/images" for name in ("brighton", "lewis", "seneca", "copr", "reichstag")
        )
        + " sacre_coeur={data}/sacre_coeur/mapping courtyard={data}/strecha/fountain-P11/images "
        f"courtyard={{data}}/strecha/entry-P10/images --work {{work}}/maps {OUT}",
        figures="photos maps placed seconds",
        text="{mapped} of {photos} photos in {maps} maps, {in_largest} in the largest of each place; {mixed} "
        "maps mix places; {placed} have a place",
        limits="mixed <= 0, 7 <= places, 0.8 <= least_share",
        minutes=15,
    ),
    _row(
        name="brighton-held-out",
        form="quick",
        claim="`brighton`: 14 of 18 photos become a map; the 4 others over Zenoh, against a map of all 18",
        commands=f"tools.real_photos --photos {BRIGHTON} --held-out {HELD_OUT} --work {{work}}/maps {OUT}",
        text="{registered} of {usable} in {ingest_s:.0f} s; " + ANSWERS,
        limits="14 <= registered, 4 <= answered, largest_m <= 1, largest_deg <= 0.5",
        readme=True,
        minutes=3,
    ),
    _row(
        name="brighton-on-scan",
        form="quick",
        claim="`brighton` anchored on its scan without a person; the 4 others over Zenoh, against poses that "
        "the scan alone gives",
        commands=f"tools.anchor_brighton {ON_SCAN} --held-out {HELD_OUT} --work {{work}}/maps {OUT}",
        figures=ERRORS,
        text=ANSWERS
        + ", stated {stated_m:.2f} m and {stated_deg:.2f} (by GPS {before_median_m:.1f} m; its focal "
        "length {gps_focal_px:.0f} px, known to {gps_focal_sigma:.1%}, the scan's {scan_focal_px:.0f}; "
        "cameras {gps_shape_m:.3f} m off after a similarity)",
        # Stated radii at least errors / 1.5, as on laser truth. The errors of one map are less than a fifth
        # of what is stated once in a hundred.
        limits="4 <= answered, median_m <= 0.3, median_deg <= 0.25, 0.67 <= stated_over_m, "
        "stated_over_m <= 5, 0.67 <= stated_over_deg, stated_over_deg <= 5, gps_focal_off <= 1, "
        "gps_shape_m <= 0.05",
        readme=True,
        minutes=4,
    ),
    _row(
        name="brighton-part-scans",
        claim="`brighton` anchored on its whole scan, on its halves and on its middle: cameras against poses "
        "that the whole scan alone gives, inside what the maps state",
        commands=f"tools.part_scans {ON_SCAN} --work {{work}}/parts {OUT}",
        text="{placed} of {parts} placed; cameras {median_m:.2f} m off at the median, at most "
        "{largest_m:.2f} m; of {cameras} {outside} outside 99.9 %; inside 68 and 95 %: position "
        "{position_68:.0%} and {position_95:.0%}, orientation {orientation_68:.0%} and {orientation_95:.0%}",
        limits="5 <= placed, outside <= 0, 0.95 <= position_95, 0.95 <= orientation_95",
        minutes=6,
    ),
    _row(
        name="brighton-located-pixels",
        claim="`brighton` anchored on its scan: pixels of the 4 others, located on the scan and by the map "
        "alone, against the scan's points that they show from poses that the scan alone gives",
        commands=f"tools.anchor_brighton --pixels {ON_SCAN} --held-out {HELD_OUT} --work {{work}}/maps {OUT}",
        figures="scan_edges scan_edge_95",
        text="of {asked} pixels {scan_located} on the scan, median {scan_median_m:.3f} m, 95 % off edges "
        "within {scan_clear_95_m:.3f} m, {scan_68:.0%} and {scan_95:.1%} inside 68 and 95 % bounds; "
        "{map_located} by the map, median {map_median_m:.3f} m, 95 % within {map_clear_95_m:.3f} m, "
        "{map_68:.0%} and {map_95:.1%} inside",
        limits="4 <= photos, scan_median_m <= 0.05, 0.9 <= scan_95, map_median_m <= 0.05, 0.9 <= map_95",
        minutes=4,
    ),
    _row(
        name="lewis-held-out",
        claim="`lewis`: every fifth of 55 oblique photos is held out, against a map of all",
        commands=f"tools.real_photos --photos {{data}}/lewis/images --work {{work}}/maps {OUT}",
        figures=ERRORS,
        text="{registered} of {usable} in {ingest_s:.0f} s; " + ANSWERS,
        limits="40 <= registered, median_m <= 1",
        minutes=12,
    ),
    _sequence("brighton/images", 0.3, 3),
    _sequence("lewis/images", 0.4, 15),
    _row(
        name="autzen-windows",
        claim="`autzen`: windows of either half of a real ortho image registered to airborne intensity, "
        "priors off by 20 m and 5 degrees, against the offset of that half",
        commands=f"tools.autzen_windows {{data}}/autzen/stadium.laz {{data}}/autzen/stadium_ortho.tif "
        f"--photos {BRIGHTON} {{data}}/lewis/images --seed 7 {OUT}",
        text="{west_close} of {west_structured} in the west and {east_close} of {east_structured} in the "
        "east within 2 m of the offset (known to {west_offset_sigma_m:.2f} and {east_offset_sigma_m:.2f} m), "
        "largest of an accepted one {largest_m:.1f} m; {foreign_accepted} of {foreign} of other places "
        "accepted; by the lowest limit of the other half {west_chosen_rate:.0%} and {east_chosen_rate:.0%}, "
        "{west_chosen_wrong} and {east_chosen_wrong} wrong",
        limits="0.6 <= west_rate, 0.6 <= east_rate, wrong <= 0, 40 <= foreign, foreign_accepted <= 0",
        minutes=40,
    ),
    _row(
        name="brighton-by-picks",
        claim="`brighton` without GPS: a map of 14 photos, placed on the scan by six picks (3 px) in one; "
        "20 draws, the 4 others asked of each",
        commands=f"tools.unplaced_brighton {ON_SCAN} --work {{work}}/draws {OUT}",
        figures="worst_deg",
        text="{placed} of {draws} placed, {wrong} wrong; median {median_m:.2f} m and "
        "{median_deg:.2f} degrees, worst draw {worst_m:.2f} m",
        limits="maps = 1, 14 <= largest, refused <= 2, wrong <= 0, median_m <= 0.25, median_deg <= 0.25",
        resumes=True,
        minutes=40,
    ),
    _row(
        name="brighton-near",
        claim="`brighton` without GPS: a map of 14 photos, looked for within 250 m of a point 100 m off; ten "
        "points each with the scan's colours, with grey values as intensities, and on a mirrored scan",
        commands=f"tools.unplaced_brighton --near {ON_SCAN} --work {{work}}/near {OUT}",
        text="{colour_placed} and {intensity_placed} of {draws} placed, {colour_wrong} and {intensity_wrong} "
        "wrong; the 4 others median {colour_median_m:.2f} and {intensity_median_m:.2f} m, "
        "{colour_median_deg:.2f} and {intensity_median_deg:.2f} degrees; mirrored: {mirrored_placed}",
        limits="7 <= colour_placed, 7 <= intensity_placed, colour_wrong <= 0, intensity_wrong <= 0, "
        "mirrored_placed <= 0, colour_median_m <= 0.25, colour_median_deg <= 0.25",
        resumes=True,
        minutes=40,
    ),
    _row(
        name="brighton-grown",
        claim="`brighton`: every second photo a map by GPS, the others without GPS placed by it, ten "
        "photos of `lewis` not; against a map of all by GPS, laid on the first",
        commands=f"tools.unplaced_grown --photos {BRIGHTON} --strange {{data}}/lewis/images "
        f"--work {{work}}/maps {OUT}",
        figures="bound_m",
        text="{grown} of {photos} placed, median {loose_median_m:.2f} m and {loose_median_deg:.2f} degrees, "
        "largest {loose_largest_m:.2f} m; the map by GPS {placed_median_m:.2f} m",
        limits="9 <= grown, strange_placed <= 0, loose_median_m <= 0.3",
        minutes=15,
    ),
    _row(
        name="karma-placed",
        claim="`karma.mp4`, 12 s by a drone straight ahead: placed by its telemetry; its track against its "
        "own GPS, inside the 95 % radius that it states",
        commands=f"tools.film_tracked {{data}}/video/karma.mp4 --work {{work}} {OUT}",
        text="{mapped} of {keyframes} keyframes, {tracked} frames tracked; radius {radius_m:.1f} m, off by "
        "{rms_m:.1f} m (root mean square) and {largest_m:.1f} m at most; {inside:.1%} of {compared} inside",
        limits="24 <= mapped, 1 <= active, 0.95 <= inside",
        minutes=1,
    ),
    _row(
        name="shifted-positions",
        claim="`brighton`, the positions of every second photo shifted by 50 km together: they become a map "
        "there, in quarantine; `ingest` beside the map of the others, `anchor` on the scan and `grow` say by "
        "how far",
        commands=f"tools.shifted_positions --photos {BRIGHTON} --scan {SCAN} --work {{work}}/maps {OUT}",
        text="{photos} photos placed; said: {ingest_km:.1f} km from the other map by the ingest, "
        "{anchor_km:.1f} km from the scan, {grow_km:.1f} km where the photos are contributed",
        limits="1 <= quarantined, 49 <= ingest_km <= 51, 49 <= anchor_km <= 51, 49 <= grow_km <= 51",
        minutes=4,
    ),
    _row(
        name="karma-in-map",
        claim="`karma.mp4`, 12 s by a drone, becomes a map without a place (paper: 98 of 115 films), and is "
        "followed in its frame; at keyframes the track agrees with the map's own cameras, relative to the "
        "distance of the points",
        commands=f"tools.film_tracked {{data}}/video/karma.mp4 --no-telemetry --work {{work}} {OUT}",
        text="{mapped} of {keyframes} keyframes, {tracked} of {frames} frames; {center_rel:.2%} and "
        "{angle_deg:.2f} degrees",
        limits="0.8 <= mapped_share, 0.9 <= tracked_share, center_rel <= 0.01",
        minutes=3,
    ),
    _row(
        name="reichstag-map",
        claim="`reichstag`: 74 photos of one landmark by many people; of those in COLMAP's largest model "
        "(exhaustive, incremental), how many are in our largest map (paper: 7 and 22 % of collections)",
        commands=f"tools.ingest_benchmark {{data}}/reichstag/images {OUT}",
        figures="ours_of_colmap_largest=both colmap_largest times=ratio placed",
        text="{ours_of_colmap_largest} of {colmap_largest} ({share:.0%}), in {times:.1f} times COLMAP's time",
        limits="0.9 <= share, placed <= 0",
        minutes=15,
    ),
    _row(
        name="reichstag-geotags",
        claim="`reichstag`, a third of its photos with geotags off by 8 m: an active map; and geotags drawn "
        "again, of 5 to 25 photos, some far out or on the landmark, against the bounds of the placement",
        commands=f"tools.landmark_tags --photos {{data}}/reichstag/images --work {{work}}/maps {OUT}",
        text="{active} of {photos} in an active map, {off_m:.1f} m off, shape {shape_m:.2f} m; of "
        "{draws:.0f} draws {answering:.0%} answer, {waiting:.0%} wait; inside 68 and 95 %: position "
        "{answering_position_68:.0%} and {answering_position_95:.1%}, orientation "
        "{answering_orientation_68:.0%} and {answering_orientation_95:.1%}; those that wait "
        "{waiting_position_95:.1%} and {waiting_orientation_95:.1%}",
        limits="0.9 <= share, off_m <= 10, shape_m <= 0.5, 0.92 <= answering_position_95, "
        "0.92 <= answering_orientation_95, 0.9 <= waiting_position_95, far <= 3",
        minutes=10,
    ),
    _laser("fountain-P11", 9, "quick", "map_deg <= 0.1, "),
    _laser("entry-P10", 8, "full"),
    _row(
        name="small-sets",
        claim="runs of four, six and eight photos of `brighton` with its GPS and of two sets with exact "
        "positions, each a map of its own: cameras against the scans, inside what the maps state",
        commands=f"tools.small_sets {{data}}/strecha/fountain-P11 {{data}}/strecha/entry-P10 {ON_SCAN} "
        f"--work {{work}}/sets {OUT}",
        text="{maps} maps of {runs} runs, {active} answer; of {photos} cameras {outside} outside 99.9 % "
        "(worst squared error {orientation_worst:.1f} of the orientation, {position_worst:.1f}; 16.3 is the "
        "bound); inside 68 and 95 %: orientation {orientation_68:.0%} and {orientation_95:.0%}, position "
        "{position_68:.0%} and {position_95:.0%}; focal length off by {focal_off:.1%} at most",
        limits="outside <= 0, 35 <= maps",
        minutes=8,
    ),
    _row(
        name="lens-widths",
        claim="how wide lenses are around what is known of them, on four real sets: the priors' widths lie "
        "where 95 % of the likelihood is",
        commands=f"tools.lens_widths --work {{work}} {OUT} --photos {BRIGHTON} {{data}}/seneca/images "
        "{data}/copr/images {data}/sacre_coeur/mapping",
        text="{lenses} lenses; focal length {focal_rel:.2%}, aspect {aspect_rel:.3%}, principal point "
        "{center_rel:.2%}, radial {radial:.3f}, tangential {tangential:.4f}; {inside} of 5 widths lie within",
        limits="5 <= inside",
        minutes=15,
    ),
    _row(
        name="position-draws",
        claim="positions made worse (noise, drift, bias, outliers, one height, a lag) of three real flights "
        "and five simulated ones, and positions that have nothing to do with the photos",
        commands=f"tools.position_draws --work {{work}}/maps --draws 40 {OUT} --photos {BRIGHTON} "
        "{data}/lewis/images {data}/seneca/images",
        text="{placed:.1%} of {flights:.0f} placed, {answer:.1%} answer; inside 68 and 95 % bounds: position "
        "{position_68:.0%} and {position_95:.1%}, orientation {orientation_68:.0%} and {orientation_95:.1%} "
        "(of those that answer {answering_position_95:.1%} and {answering_orientation_95:.1%} inside 95 %); "
        "of {random:.0f} at random {random_answer:.0f} answer, of {shuffled:.0f} shuffled "
        "{shuffled_answer:.0f}, of {other:.0f} of other flights {other_answer:.0f}",
        limits="0.95 <= placed, 0.63 <= position_68 <= 0.73, 0.92 <= position_95, 0.63 <= orientation_68 <= "
        "0.73, 0.92 <= orientation_95, 0.95 <= answering_position_95, 0.95 <= answering_orientation_95, "
        "random_answer <= 1, shuffled_answer <= 0, other_answer <= 0",
        minutes=30,
    ),
    _row(
        name="strip-draws",
        claim="single strips of photos, nine of `brighton` and simulated ones, placed by positions with the "
        "cameras' angles and without",
        commands=f"tools.strip_draws {ON_SCAN} --draws 300 {OUT}",
        text="; ".join(_STRIPS.replace("KIND", kind) for kind in ("real", "simulated")),
        limits="1 <= real_answer, real_without_answer <= 0, 0.85 <= simulated_answer, "
        "simulated_without_answer <= 0.05, "
        + ", ".join(
            f"0.92 <= {kind}_{part}_95"
            for kind in ("real", "simulated")
            for part in ("position", "orientation", "without_position", "without_orientation")
        ),
        minutes=5,
    ),
    _row(
        name="copr-control-points",
        claim="`copr`: 41 kite photos without GPS, placed by ten ground control points, good to 0.8 m",
        commands="tools.made_maps copr={data}/copr/images --gcp {data}/copr/gcp_list.txt "
        f"--work {{work}}/maps {OUT}",
        text="{largest} of {photos} in a map, {placed} placed, residual {residual_m:.2f} m",
        limits="38 <= largest, 1 <= placed, residual_m <= 1.5",
        minutes=5,
    ),
    _row(
        name="brighton-frames-on-scan",
        form="quick",
        claim="`brighton`: single photos registered to the scan, without a map, by GPS with unknown heading "
        "and again from 15 m and 10 degrees off",
        commands=f"tools.frame_real_photos {SCAN} {BRIGHTON} --lens {BRIGHTON_LENS} "
        f"--photos {HELD_OUT} {OUT}",
        figures="cpu_s",
        text="{accepted} of {photos}, both at one pose to {largest_apart_m:.2f} m and "
        "{largest_apart_deg:.2f} degrees",
        limits="4 <= accepted, largest_apart_m <= 0.3, largest_apart_deg <= 0.25",
        minutes=2,
    ),
    _row(
        name="seneca-map",
        claim="`seneca`: 60 photos of a flying wing over bare fields become a map",
        commands=f"tools.made_maps seneca={{data}}/seneca/images --work {{work}}/maps {OUT}",
        text="{largest} in the largest of {maps} maps, {mapped} in all",
        limits="54 <= largest",
        minutes=5,
    ),
    _portions("brighton/images", "interleaved", 4),
    _portions("brighton/images", "consecutive", 4),
    _portions("lewis/images", "consecutive", 20),
    _portions("copr/images", "consecutive", 15),
    _portions("sacre_coeur/mapping", "interleaved", 4),
    _row(
        name="growth-gates",
        claim="what gates of growth let pass is right, of `brighton` and `sacre_coeur` in three portions",
        commands="".join(
            f"tools.growth_portions --photos {{data}}/{photos} --cut {cut} --work {{work}}/cache "
            f"--gates {{work}}/{k}.jsonl\n"
            for k, (photos, cut) in enumerate(
                product(("brighton/images", "sacre_coeur/mapping"), ("interleaved", "consecutive"))
            )
        )
        + f"tools.growth_gates {{work}}/0.jsonl {{work}}/1.jsonl {{work}}/2.jsonl {{work}}/3.jsonl {OUT}",
        text="{judged} placements judged; {refine_right} right and {refine_wrong} wrong photos pass the "
        "refinement, {budget_right} and {budget_wrong} the drift budget, {trust_right} and {trust_wrong} all "
        "gates; gates that alone refuse a placement cost {alone_right} right photos and keep out "
        "{alone_wrong} wrong ones",
        limits="trust_wrong <= 0",
        minutes=8,
    ),
)
