"""Rows of real photos, films and scans."""

from typing import Any

from tools.scoreboard.row import Form, Limit, Row
from tools.scoreboard.words import ANSWERS, BRIGHTON, BRIGHTON_LENS, ERRORS, HELD_OUT, OUT, SCAN, same

_LENS_SETS = ("brighton/images", "seneca/images", "copr/images", "sacre_coeur/mapping")
_CUTS = ("interleaved", "consecutive")


def _portions(photos: str, cut: str, minutes: float) -> Row:
    return Row(
        name=f"{photos.split('/')[0]}-portions-{cut}",
        group="real",
        form="full",
        claim=f"`{photos.split('/')[0]}` in three portions ({cut}), grown, against all at once",
        commands=(
            (
                *("tools.growth_portions", "--photos", f"{{data}}/{photos}", "--cut", cut),
                *("--work", "{work}/cache", *OUT),
            ),
        ),
        text="{grown} of {joint}, median {median_m:.3f} m, largest {largest_m:.3f} m",
        limits=(Limit(figure="missing", most=0), Limit(figure="median_m", most=0.3)),
        needs=(photos,),
        minutes=minutes,
    )


_GATED = tuple((photos, cut) for photos in ("brighton/images", "sacre_coeur/mapping") for cut in _CUTS)


def _gates() -> Row:
    return Row(
        name="growth-gates",
        group="real",
        form="full",
        claim="what gates of growth let pass is right, of `brighton` and `sacre_coeur` in three portions",
        commands=(
            *(
                (
                    *("tools.growth_portions", "--photos", f"{{data}}/{photos}", "--cut", cut),
                    *("--work", "{work}/cache", "--gates", f"{{work}}/{k}.jsonl"),
                )
                for k, (photos, cut) in enumerate(_GATED)
            ),
            ("tools.growth_gates", *(f"{{work}}/{k}.jsonl" for k in range(len(_GATED))), *OUT),
        ),
        text="{judged} placements judged; {refine_right} right and {refine_wrong} wrong photos pass; gates "
        "that alone refuse a placement cost {alone_right} right photos and keep out {alone_wrong} wrong ones",
        limits=(Limit(figure="refine_wrong", most=0),),
        needs=tuple(photos for photos, _ in _GATED),
        minutes=8,
    )


def _sequence(photos: str, median_m: float, minutes: float) -> Row:
    name = photos.split("/")[0]
    return Row(
        name=f"{name}-as-film",
        group="real",
        form="full",
        claim=f"`{name}`: every second photo is a map, all are played as a film and tracked",
        commands=(("tools.real_sequence", "--photos", f"{{data}}/{photos}", "--work", "{work}/maps", *OUT),),
        figures=same("unknown"),
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
        commands=(("tools.made_maps", *words, "--work", "{work}/maps", *OUT),),
        text="{largest} in the largest of {maps} maps, {mapped} in all",
        limits=(Limit(figure="largest", least=least),),
        needs=(need,),
        **more,
    )


def _laser(name: str, photos: int, form: Form, *limits: Limit) -> Row:
    return Row(
        name=f"strecha-{name}",
        group="real",
        form=form,
        claim=f"`strecha/{name}`: {photos} photos with exact positions become a map, others are asked, their "
        "camera told and unknown; against a laser scan, beside COLMAP given the true lens",
        commands=(("tools.laser_truth", f"{{data}}/strecha/{name}", *OUT),),
        figures=same("map_reported_deg", "told_reported_m"),
        text="{map_found} photos; map {map_m:.4f} m and {map_deg:.3f} degrees (COLMAP {map_colmap_m:.4f} m), "
        "told {told_m:.4f} m and {told_deg:.3f}, unknown {unknown_m:.4f} m and {unknown_deg:.3f} "
        "(COLMAP {told_colmap_m:.4f} m); worst ratio {worst:.1f}; lens off by {lens_off:.1f} of its sigmas",
        limits=(
            *limits,
            Limit(figure="map_found", least=photos),
            Limit(figure="worst", most=1.5),
            Limit(figure="lens_off", most=1.8),  # 99.9 % of eight parameters
        ),
        needs=(f"strecha/{name}",),
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
    Row(
        name="brighton-held-out",
        group="real",
        form="quick",
        claim="`brighton`: 14 of 18 photos become a map; the 4 others over Zenoh, against a map of all 18",
        commands=(("tools.real_photos", "--photos", BRIGHTON, "--held-out", *HELD_OUT, *OUT),),
        text="{registered} of {usable} in {ingest_s:.0f} s; " + ANSWERS,
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
                *("tools.anchor_brighton", "--photos", BRIGHTON, "--scan", SCAN),
                *("--poses", "{cache}/brighton-poses.json", "--held-out", *HELD_OUT, *OUT),
            ),
        ),
        figures=ERRORS,
        text=ANSWERS + " (by GPS {before_median_m:.1f} m; its focal length {gps_focal_px:.0f} px, known to "
        "{gps_focal_sigma:.1%}, the scan's {scan_focal_px:.0f}; cameras {gps_shape_m:.3f} m off after a "
        "similarity)",
        limits=(
            Limit(figure="answered", least=4),
            Limit(figure="median_m", most=0.30),
            Limit(figure="median_deg", most=0.25),
            Limit(figure="gps_focal_off", most=1.0),  # of 1 % or its own sigma, the larger
            Limit(figure="gps_shape_m", most=0.05),
        ),
        needs=("brighton/images", "brighton/model.laz"),
        readme=True,
        minutes=4,
    ),
    Row(
        name="brighton-located-pixels",
        group="real",
        form="full",
        claim="`brighton` anchored on its scan: pixels of the 4 others, located on the scan and by the map "
        "alone, against the scan's points that they show from poses that the scan alone gives",
        commands=(
            (
                *("tools.locate_brighton", "--photos", BRIGHTON, "--scan", SCAN),
                *("--poses", "{cache}/brighton-poses.json", "--held-out", *HELD_OUT, *OUT),
            ),
        ),
        figures=same("scan_edges", "scan_edge_95"),
        text="of {asked} pixels {scan_located} on the scan, median {scan_median_m:.3f} m, 95 % off edges "
        "within {scan_clear_95_m:.3f} m, {scan_68:.0%} and {scan_95:.1%} inside 68 and 95 % bounds; "
        "{map_located} by the map, median {map_median_m:.3f} m, 95 % within {map_clear_95_m:.3f} m, "
        "{map_68:.0%} and {map_95:.1%} inside",
        limits=(
            Limit(figure="photos", least=4),
            Limit(figure="scan_median_m", most=0.05),
            Limit(figure="scan_95", least=0.90),
            Limit(figure="map_median_m", most=0.05),
            Limit(figure="map_95", least=0.90),
        ),
        needs=("brighton/images", "brighton/model.laz"),
        minutes=4,
    ),
    Row(
        name="lewis-held-out",
        group="real",
        form="full",
        claim="`lewis`: every fifth of 55 oblique photos is held out, against a map of all",
        commands=(("tools.real_photos", "--photos", "{data}/lewis/images", *OUT),),
        figures=ERRORS,
        text="{registered} of {usable} in {ingest_s:.0f} s; " + ANSWERS,
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
                *("--photos", BRIGHTON, "{data}/lewis/images", "--seed", "7", *OUT),
            ),
        ),
        text="{close} of {structured} within 1.5 m, largest of an accepted one {largest_m:.1f} m; "
        "{foreign_accepted} of {foreign} of other places accepted",
        limits=(
            Limit(figure="rate", least=0.75),
            Limit(figure="wrong", most=0),
            Limit(figure="foreign_accepted", most=0),
        ),
        needs=("autzen", "brighton/images", "lewis/images"),
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
                *("tools.unplaced_brighton", "--photos", BRIGHTON, "--scan", SCAN),
                *("--poses", "{cache}/brighton-poses.json", "--work", "{work}/draws", *OUT),
            ),
        ),
        figures=same("worst_deg"),
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
        resumes=True,
        minutes=40,
    ),
    Row(
        name="brighton-grown",
        group="real",
        form="full",
        claim="`brighton`: every second photo a map by GPS, the others without GPS placed by it, ten "
        "photos of `lewis` not; against scan poses laid on the first map",
        commands=(
            (
                *("tools.unplaced_grown", "--photos", BRIGHTON, "--scan", SCAN),
                *("--strange", "{data}/lewis/images"),
                *("--poses", "{cache}/brighton-poses.json", "--work", "{work}/maps", *OUT),
            ),
        ),
        figures=same("bound_m"),
        text="{grown} of {photos} placed, median {loose_median_m:.2f} m and {loose_median_deg:.2f} degrees, "
        "largest {loose_largest_m:.2f} m; the map by GPS {placed_median_m:.2f} m",
        limits=(
            Limit(figure="grown", least=9),
            Limit(figure="strange_placed", most=0),
            Limit(figure="loose_median_m", most=0.3),
        ),
        needs=("brighton/images", "brighton/model.laz", "lewis/images"),
        minutes=15,
    ),
    Row(
        name="karma-placed",
        group="real",
        form="full",
        claim="`karma.mp4`, 12 s by a drone straight ahead: placed by its telemetry; its track against its "
        "own GPS, inside the 95 % radius that it states",
        commands=(("tools.film_placed", "{data}/video/karma.mp4", "--work", "{work}", *OUT),),
        text="{mapped} of {keyframes} keyframes, {tracked} frames tracked; radius {radius_m:.1f} m, off by "
        "{rms_m:.1f} m (root mean square) and {largest_m:.1f} m at most; {inside:.1%} of {compared} inside",
        limits=(
            Limit(figure="mapped", least=24),
            Limit(figure="active", least=1),
            Limit(figure="inside", least=0.95),
        ),
        needs=("video/karma.mp4",),
        minutes=1,
    ),
    Row(
        name="shifted-positions",
        group="real",
        form="full",
        claim="`brighton`, the positions of every second photo shifted by 50 km together: they become a map "
        "there, in quarantine; `ingest` beside the map of the others, `anchor` on the scan and `grow` say by "
        "how far",
        commands=(
            (
                *("tools.shifted_positions", "--photos", BRIGHTON, "--scan", SCAN),
                *("--work", "{work}/maps", *OUT),
            ),
        ),
        text="{photos} photos placed; said: {ingest_km:.1f} km from the other map by the ingest, "
        "{anchor_km:.1f} km from the scan, {grow_km:.1f} km where the photos are contributed",
        limits=(
            Limit(figure="quarantined", least=1),
            *(Limit(figure=f"{who}_km", least=49.0, most=51.0) for who in ("ingest", "anchor", "grow")),
        ),
        needs=("brighton/images", "brighton/model.laz"),
        minutes=4,
    ),
    Row(
        name="karma-in-map",
        group="real",
        form="full",
        claim="`karma.mp4`, 12 s by a drone, becomes a map without a place (paper: 98 of 115 films), and is "
        "followed in its frame; at keyframes the track agrees with the map's own cameras, relative to the "
        "distance of the points",
        commands=(("tools.film_in_map", "{data}/video/karma.mp4", "--work", "{work}", *OUT),),
        text="{mapped} of {keyframes} keyframes, {tracked} of {frames} frames; {center_rel:.2%} and "
        "{angle_deg:.2f} degrees",
        limits=(
            Limit(figure="mapped_share", least=0.8),
            Limit(figure="tracked_share", least=0.9),
            Limit(figure="center_rel", most=0.01),
        ),
        needs=("video/karma.mp4",),
        minutes=3,
    ),
    Row(
        name="reichstag-map",
        group="real",
        form="full",
        claim="`reichstag`: 74 photos of one landmark by many people; of those in COLMAP's largest model "
        "(exhaustive, incremental), how many are in our largest map (paper: 7 and 22 % of collections)",
        commands=(
            (
                *("tools.colmap_baseline", "{data}/reichstag/images", "--no-positions"),
                *("--work", "{cache}/reichstag", *OUT),
            ),
        ),
        text="{ours_of_colmap_largest} of {colmap_largest} ({share:.0%}), in {times:.1f} times COLMAP's time",
        limits=(Limit(figure="share", least=0.9), Limit(figure="placed", most=0)),
        needs=("reichstag/images",),
        minutes=15,
    ),
    _laser("fountain-P11", 9, "quick", Limit(figure="map_deg", most=0.1)),
    _laser("entry-P10", 8, "full"),
    Row(
        name="lens-widths",
        group="real",
        form="full",
        claim="how wide lenses are around what is known of them, on four real sets: the priors' widths lie "
        "where 95 % of the likelihood is",
        commands=(
            (
                *("tools.lens_widths", "--work", "{work}", *OUT, "--photos"),
                *(f"{{data}}/{folder}" for folder in _LENS_SETS),
            ),
        ),
        text="{lenses} lenses; focal length {focal_rel:.2%}, aspect {aspect_rel:.3%}, principal point "
        "{center_rel:.2%}, radial {radial:.3f}, tangential {tangential:.4f}; {inside} of 5 widths lie within",
        limits=(Limit(figure="inside", least=5),),
        needs=_LENS_SETS,
        minutes=15,
    ),
    Row(
        name="position-draws",
        group="real",
        form="full",
        claim="positions made worse (noise, drift, bias, outliers, one height, a lag) of three real flights "
        "and five simulated ones, and positions that have nothing to do with the photos",
        commands=(
            (
                *("tools.position_draws", "--work", "{work}/maps", "--draws", "40", *OUT, "--photos"),
                *(f"{{data}}/{name}/images" for name in ("brighton", "lewis", "seneca")),
            ),
        ),
        text="{placed:.1%} of {flights:.0f} placed, {answer:.1%} answer; inside 68 and 95 % bounds: position "
        "{position_68:.0%} and {position_95:.1%}, orientation {orientation_68:.0%} and {orientation_95:.1%} "
        "(of those that answer {answering_position_95:.1%} and {answering_orientation_95:.1%} inside 95 %); "
        "of {random:.0f} at random {random_answer:.0f} answer, of {shuffled:.0f} shuffled "
        "{shuffled_answer:.0f}, of {other:.0f} of other flights {other_answer:.0f}",
        limits=(
            Limit(figure="placed", least=0.95),
            Limit(figure="position_68", least=0.63, most=0.73),
            Limit(figure="position_95", least=0.92),
            Limit(figure="orientation_68", least=0.63, most=0.73),
            Limit(figure="orientation_95", least=0.92),
            Limit(figure="answering_position_95", least=0.95),
            Limit(figure="answering_orientation_95", least=0.95),
            Limit(figure="random_answer", most=1),
            Limit(figure="shuffled_answer", most=0),
            Limit(figure="other_answer", most=0),
        ),
        needs=("brighton/images", "lewis/images", "seneca/images"),
        minutes=30,
    ),
    Row(
        name="strip-draws",
        group="real",
        form="full",
        claim="single strips of photos, nine of `brighton` and simulated ones, placed by positions with the "
        "cameras' angles and without",
        commands=(
            ("tools.scan_poses", SCAN, BRIGHTON, "--poses", "{cache}/brighton_poses.json"),
            (
                *("tools.strip_draws", "--poses", "{cache}/brighton_poses.json", "--photos", BRIGHTON),
                *("--draws", "300", *OUT),
            ),
        ),
        text="; ".join(_STRIPS.replace("KIND", kind) for kind in ("real", "simulated")),
        limits=(
            Limit(figure="real_answer", least=1),
            Limit(figure="real_without_answer", most=0),
            Limit(figure="simulated_answer", least=0.85),
            Limit(figure="simulated_without_answer", most=0.05),
            *(
                Limit(figure=f"{kind}_{part}_95", least=0.92)
                for kind in ("real", "simulated")
                for part in ("position", "orientation", "without_position", "without_orientation")
            ),
        ),
        needs=("brighton",),
        minutes=5,
    ),
    Row(
        name="copr-control-points",
        group="real",
        form="full",
        claim="`copr`: 41 kite photos without GPS, placed by ten ground control points, good to 0.8 m",
        commands=(
            (
                *("tools.made_maps", "--photos", "{data}/copr/images", "--gcp", "{data}/copr/gcp_list.txt"),
                *("--work", "{work}/maps", *OUT),
            ),
        ),
        text="{largest} of {photos} in a map, {placed} placed, residual {residual_m:.2f} m",
        limits=(
            Limit(figure="largest", least=38),
            Limit(figure="placed", least=1),
            Limit(figure="residual_m", most=1.5),
        ),
        needs=("copr/images", "copr/gcp_list.txt"),
        minutes=5,
    ),
    Row(
        name="brighton-frames-on-scan",
        group="real",
        form="quick",
        claim="`brighton`: single photos registered to the scan, without a map, by GPS with unknown heading "
        "and again from 15 m and 10 degrees off",
        commands=(
            (
                *("tools.frame_real_photos", SCAN, BRIGHTON, "--lens", BRIGHTON_LENS),
                *("--photos", *HELD_OUT, *OUT),
            ),
        ),
        figures=same("cpu_s"),
        text="{accepted} of {photos}, both at one pose to {largest_apart_m:.2f} m and "
        "{largest_apart_deg:.2f} degrees",
        limits=(
            Limit(figure="accepted", least=4),
            Limit(figure="largest_apart_m", most=0.3),
            Limit(figure="largest_apart_deg", most=0.25),
        ),
        needs=("brighton/images", "brighton/model.laz"),
        minutes=2,
    ),
    _made(
        *("seneca-map", "`seneca`: 60 photos of a flying wing over bare fields become a map"),
        *(("--photos", "{data}/seneca/images"), "seneca/images", 54),
        minutes=5,
    ),
    _portions("brighton/images", "interleaved", 4),
    _portions("brighton/images", "consecutive", 4),
    _portions("lewis/images", "consecutive", 20),
    _portions("copr/images", "consecutive", 15),
    _portions("sacre_coeur/mapping", "interleaved", 4),
    _gates(),
)
