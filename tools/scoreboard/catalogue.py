"""The rows: what README and docs claim, and the command that measures each claim."""

from functools import partial

from tools.scoreboard.real_rows import REAL
from tools.scoreboard.row import Row
from tools.scoreboard.simulated_rows import SIMULATED
from tools.scoreboard.words import BRIGHTON, OUT

_row = partial(Row, group="speed")
# Points for each image that a thinned map keeps.
_COVERS = ("all", "800", "200", "50", "15")
# Sets whose ingest is timed.
_INGESTED = ("brighton", "lewis", "copr", "seneca")
# A database of `brighton`, which the next command uses.
_MADE = f"featuredb.cli ingest photos {{work}}/db {BRIGHTON} --quiet\n"

SPEED: tuple[Row, ...] = (
    _row(
        name="query-time",
        form="quick",
        claim="one 12-megapixel photo of `brighton` with its GPS over Zenoh (medians), beside OpenCV's SIFT "
        "alone and its decoding",
        commands=f"{_MADE}tools.query_benchmark {{work}}/db {BRIGHTON}/DJI_0020.JPG "
        f"{BRIGHTON}/DJI_0033.JPG {OUT}",
        figures="in_process_ms asked localised sift_ms",
        text="{wall_ms:.0f} ms, of which transport {transport_ms:.1f} ms; without decoding {over_sift:.2f} "
        "times SIFT alone, decoding {over_decode:.2f} times OpenCV's",
        limits="wall_ms <= 1000, transport_ms <= 10, over_sift <= 0.5, over_decode <= 1",
        readme=True,
        minutes=2,
    ),
    _row(
        name="sift",
        claim="our SIFT beside OpenCV's, the same photos on one thread: processor time, and inliers of "
        "neighbouring photos of `brighton`, `seneca`, `lewis`, `copr` and `reichstag` with ours, and across",
        commands="tools.sift_against_opencv "
        + " ".join(f"{{data}}/{name}/images" for name in ("brighton", "seneca", "lewis", "copr", "reichstag"))
        + f" {OUT}",
        figures="photos ours_ms opencv_inliers",
        text="{time_ratio:.2f} times OpenCV's time; {inliers_ratio:.3f} times its {opencv_inliers:.0f} "
        "inliers, across {across_ratio:.3f} times; {photos} photos",
        limits="time_ratio <= 0.7, 0.98 <= inliers_ratio, 0.95 <= across_ratio",
        minutes=4,
    ),
    _row(
        name="ingest-time",
        claim="ingest of `brighton`, `lewis`, `copr` and `seneca` against COLMAP's own pipeline, processor "
        "time of one run",
        commands=f"tools.ingest_benchmark {BRIGHTON} "
        + " ".join(f"{{data}}/{name}/images" for name in _INGESTED[1:])
        + f" {OUT}",
        figures=" ".join(f"{photos}_ours_s {photos}_colmap_s" for photos in _INGESTED),
        text="times COLMAP's time, photos registered (in the largest map), COLMAP's: "
        + ", ".join(
            f"{{{name}_ratio:.2f}} {{{name}_ours_photos:.0f}} ({{{name}_ours_largest:.0f}}) "
            f"{{{name}_colmap_photos:.0f}} ({{{name}_colmap_largest:.0f}})"
            for name in _INGESTED
        ),
        limits="worst_ratio <= 0.5, fewer <= 0",
        minutes=35,
    ),
    _row(
        name="bulk-ingest",
        claim="1,000 photos of one flight over a simulated town whose houses look alike, with a receiver's "
        "positions, beside the first 200 of them: processor time a photo, the largest of its processes, its "
        "maps against the truth",
        commands=f"tools.bulk_ingest --work {{work}}/bulk --seed 5 {OUT}",
        figures="photos share first_s off_5_wrong_left_out off_5_right_left_out off_20_right_left_out "
        "off_30_wrong_left_out off_30_right_left_out",
        text="{placed:.0f} of {photos:.0f} photos in {maps:.0f} maps, {wrong:.0f} wrong, {median_m:.2f} m, "
        "largest {largest_m:.2f} m; {a_photo_s:.2f} s a photo, {ratio:.2f} times that of the first; "
        "{largest_mb:.0f} MB; {off_0_wrong_left_out:.0f} of {wrong_pairs:.0f} wrong pairs left out "
        "({off_20_wrong_left_out:.0f} with a fifth of the positions off by 300 m) and "
        "{off_0_right_left_out:.0f} "
        "right ones of {pairs:.0f}",
        limits="0.99 <= share, wrong <= 0, maps <= 2, ratio <= 1.15, largest_mb <= 2048",
        minutes=60,
    ),
    _row(
        name="far-pairs",
        claim="verified pairs of real flights that are left out, since their photos are too far apart by "
        "their positions",
        commands=f"tools.far_pairs {BRIGHTON} {{data}}/lewis/images {{data}}/seneca/images "
        f"--work {{work}}/pairs {OUT}",
        figures="brighton_left_out lewis_left_out seneca_left_out",
        text="{left_out:.0f} of {pairs:.0f}, the strongest with {lewis_most_matches:.0f} matches",
        limits="left_out_share <= 0.01",
        minutes=10,
    ),
    _row(
        name="memory-curve",
        claim="`seneca`'s map of all photos but every fifth, thinned to so many points for each image; the "
        "others over Zenoh, against a map of all",
        commands=f"tools.memory_curve --photos {{data}}/seneca/images --work {{work}}/maps {OUT}",
        figures=" ".join(f"cover_{k}_size_ratio cover_{k}_kept cover_{k}_largest_m" for k in _COVERS),
        text="points an image, megabytes a km2, answered, median error: "
        + "; ".join(
            f"{cover} {{cover_{cover}_megabytes_a_km2:.0f}} {{cover_{cover}_answered:.0f}} of "
            f"{{cover_{cover}_asked:.0f}} {{cover_{cover}_median_m:.2f}} m"
            for cover in _COVERS
        ),
        limits="0.9 <= cover_200_kept",
        minutes=12,
    ),
    _row(
        name="scale-1m",
        claim="a million points, the maps of `brighton` and `seneca` over and over, beside one each: start "
        "to the first answer, commit of 100 points until a query is answered, queries with a prior of 30 m "
        "and without",
        commands=f"{_MADE}featuredb.cli ingest photos {{work}}/seneca {{data}}/seneca/images --quiet\n"
        f"tools.scale_benchmark {{work}}/db:{BRIGHTON} {{work}}/seneca:{{data}}/seneca/images "
        f"--work {{work}}/scale {OUT}",
        figures=(
            "large_points large_first_start_s large_start_s large_commit_s large_with_prior_ms "
            "large_without_ms anonymous_bytes_a_point"
        ),
        text="{times_start:.1f} times the start, {times_commit:.1f} times the commit, {times_with_prior:.2f} "
        "and {times_without:.2f} times a query with a prior and without; {large_answered_without:.0%} "
        "answered without, {large_wrong:.0f} wrong; {resident_bytes_a_point:.0f} bytes a point; the very "
        "first start {large_first_start_s:.0f} s",
        limits="times_start <= 3, times_commit <= 3, times_with_prior <= 1.2, times_without <= 3, "
        "0.97 <= large_answered_with_prior, 0.97 <= large_answered_without, large_wrong <= 0, "
        "resident_bytes_a_point <= 250",
        minutes=15,
    ),
    _row(
        name="many-servers",
        claim="servers of one database behind a router, each of whose workers takes 100 ms for a photo: "
        "queries a second of two and four, in those of one; and queries lost when one of two is killed",
        commands=f"tools.many_servers {OUT}",
        figures="one_per_s killed_answered",
        text="{two_times:.2f} and {four_times:.2f} times the queries of one; {killed_lost:.0f} of "
        "{killed_answered:.0f} lost",
        limits="1.8 <= two_times, 3.4 <= four_times, killed_lost <= 0",
        minutes=3,
    ),
    _row(
        name="service-attacks",
        claim="a real map of `brighton` with copies of it to 200,000 points, served with keys: honest "
        "clients' answer times and the server's memory under eleven attacks (tools/attacks.py)",
        commands=f"{_MADE}tools.attacks_benchmark {{work}}/db {BRIGHTON} {OUT}",
        figures="points asked quiet_mib after_mib worst_http_p99_s failures_by_kills",
        text="99 % within {quiet_p99_s:.2f} s quiet, {worst_p99_s:.2f} s under the worst attack, {failures} "
        "failed, {wrong} wrong; {peak_mib:.0f} MiB at the peak",
        # A failed question counts as the deadline, 8 s.
        limits="200000 <= points, worst_p99_s <= 7.9, wrong <= 0, peak_mib <= 8192",
        minutes=12,
    ),
    _row(
        name="service-soak",
        claim="a server for an hour: queries with and without priors, commits, reloads, killed workers, "
        "broken messages",
        commands=f"{_MADE}tools.service_soak {{work}}/db {BRIGHTON} --minutes 60 {OUT}",
        figures="failed p99_s late_mib exit_code",
        text="{asked} questions, {wrong} wrong, {missing} without a reply, {kills} workers killed, {reloads} "
        "reloads; {grown_mib:+.0f} MiB",
        limits="wrong <= 0, missing <= 0, grown_mib <= 100, exit_code = 0",
        minutes=65,
    ),
    _row(
        name="service-stops",
        claim="a server told to stop in the middle of its load, 200 times",
        commands=f"{_MADE}tools.service_stops {{work}}/db {BRIGHTON} {OUT}",
        figures="stops slowest_s",
        text="{clean} of {stops} clean, the slowest in {slowest_s:.1f} s",
        limits="200 <= clean",
        minutes=25,
    ),
    _row(
        name="scan-memory",
        claim="100 million points added by `lidar add`",
        commands=f"tools.lidar_memory --points 100000000 --folder {{work}}/scan {OUT}",
        figures="points_per_cpu_second",
        text="{peak_tree_mib:.0f} MiB at the peak, {cpu_seconds:.0f} s of a core",
        limits="peak_tree_mib <= 2048",
        minutes=15,
    ),
)

ROWS: tuple[Row, ...] = (*REAL, *SIMULATED, *SPEED)
