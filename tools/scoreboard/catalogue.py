"""The rows: what README and docs claim, and the command that measures each claim."""

from tools.scoreboard.real_rows import REAL
from tools.scoreboard.row import Limit, Row
from tools.scoreboard.simulated_rows import SIMULATED
from tools.scoreboard.words import BRIGHTON, OUT, same

# A database of `brighton`, which the next command uses.
_MADE = ("featuredb.cli", "ingest", "photos", "{work}/db", BRIGHTON, "--quiet")

SPEED: tuple[Row, ...] = (
    Row(
        name="query-time",
        group="speed",
        form="quick",
        claim="one 12-megapixel photo of `brighton` with its GPS over Zenoh (medians)",
        commands=(
            _MADE,
            (
                *("tools.query_benchmark", "{work}/db", f"{BRIGHTON}/DJI_0020.JPG"),
                *(f"{BRIGHTON}/DJI_0033.JPG", *OUT),
            ),
        ),
        figures=same("in_process_ms", "asked", "localised"),
        text="{wall_ms:.0f} ms, of which transport {transport_ms:.1f} ms",
        limits=(Limit(figure="wall_ms", most=1000), Limit(figure="transport_ms", most=10)),
        needs=("brighton/images",),
        readme=True,
        minutes=2,
    ),
    Row(
        name="ingest-time",
        group="speed",
        form="full",
        claim="ingest of `brighton` and `seneca` against COLMAP's own pipeline, processor time of one run",
        commands=(("tools.ingest_benchmark", BRIGHTON, "{data}/seneca/images", *OUT),),
        figures=same("brighton_ours_s", "brighton_colmap_s", "seneca_ours_s", "seneca_colmap_s"),
        text="{brighton_ratio:.2f} and {seneca_ratio:.2f} times COLMAP's time; {brighton_ours_photos:.0f} "
        "and {seneca_ours_photos:.0f} photos in a map, COLMAP {brighton_colmap_photos:.0f} and "
        "{seneca_colmap_photos:.0f}",
        limits=(Limit(figure="worst_ratio", most=0.5), Limit(figure="fewer", most=0)),
        needs=("brighton/images", "seneca/images"),
        minutes=15,
    ),
    Row(
        name="bridge-latency",
        group="speed",
        form="full",
        claim="`live --json | bridge` on a film that shows a photo of `brighton`: from a reply as any "
        "subscriber gets it to the bridge's message, decoded (pymavlink from UDP, rosbags from Zenoh)",
        commands=(
            _MADE,
            ("tools.bridge_latency", "{work}/db", f"{BRIGHTON}/DJI_0025.JPG", *OUT),
        ),
        figures=same(
            "load",
            "mavlink_poses",
            "ros2_poses",
            "mavlink_99_ms",
            "ros2_99_ms",
            "mavlink_wire_99_ms",
            "ros2_wire_99_ms",
        ),
        text="MAVLink: median {mavlink_median_ms:.1f} ms, 95 % within {mavlink_95_ms:.1f} ms of "
        "{mavlink_decoded}, the slowest hundredth {mavlink_over_wire_99_ms:.1f} ms later than the wire's; "
        "ROS 2: {ros2_median_ms:.1f} ms, {ros2_95_ms:.1f} ms of {ros2_decoded}, "
        "{ros2_over_wire_99_ms:.1f} ms",
        limits=tuple(
            limit
            for kind in ("mavlink", "ros2")
            for limit in (
                Limit(figure=f"{kind}_95_ms", most=5),
                Limit(figure=f"{kind}_over_wire_99_ms", most=5),
                Limit(figure=f"{kind}_decoded", least=100),  # the 99th percentile is one of them
            )
        ),
        needs=("brighton/images",),
        minutes=4,
    ),
    Row(
        name="service-attacks",
        group="speed",
        form="full",
        claim="a real map of `brighton` with copies of it to 200,000 points, served with keys: honest "
        "clients' answer times and the server's memory under eleven attacks (tools/attacks.py)",
        commands=(
            _MADE,
            ("tools.attacks_benchmark", "{work}/db", BRIGHTON, *OUT),
        ),
        figures=same("points", "asked", "quiet_mib", "after_mib", "worst_http_p99_s", "failures_by_kills"),
        text="99 % within {quiet_p99_s:.2f} s quiet, {worst_p99_s:.2f} s under the worst attack, {failures} "
        "failed, {wrong} wrong; {peak_mib:.0f} MiB at the peak",
        limits=(
            Limit(figure="points", least=200_000),
            Limit(figure="worst_p99_s", most=7.9),  # a failed question counts as the deadline, 8 s
            Limit(figure="wrong", most=0),
            Limit(figure="peak_mib", most=8192),
        ),
        needs=("brighton/images",),
        minutes=12,
    ),
    Row(
        name="service-soak",
        group="speed",
        form="full",
        claim="a server for an hour: queries with and without priors, commits, reloads, killed workers, "
        "broken messages",
        commands=(
            _MADE,
            ("tools.service_soak", "{work}/db", BRIGHTON, "--minutes", "60", *OUT),
        ),
        figures=same("failed", "p99_s", "late_mib", "exit_code"),
        text="{asked} questions, {wrong} wrong, {missing} without a reply, {kills} workers killed, {reloads} "
        "reloads; {grown_mib:+.0f} MiB",
        limits=(
            Limit(figure="wrong", most=0),
            Limit(figure="missing", most=0),
            Limit(figure="grown_mib", most=100),
            Limit(figure="exit_code", least=0, most=0),
        ),
        needs=("brighton/images",),
        minutes=65,
    ),
    Row(
        name="service-stops",
        group="speed",
        form="full",
        claim="a server told to stop in the middle of its load, 200 times",
        commands=(
            _MADE,
            ("tools.service_stops", "{work}/db", BRIGHTON, *OUT),
        ),
        figures=same("stops", "slowest_s"),
        text="{clean} of {stops} clean, the slowest in {slowest_s:.1f} s",
        limits=(Limit(figure="clean", least=200),),
        needs=("brighton/images",),
        minutes=25,
    ),
    Row(
        name="scan-memory",
        group="speed",
        form="full",
        claim="100 million points added by `lidar add`",
        commands=(("tools.lidar_memory", "--points", "100000000", "--folder", "{work}/scan", *OUT),),
        figures=same("points_per_cpu_second"),
        text="{peak_tree_mib:.0f} MiB at the peak, {cpu_seconds:.0f} s of a core",
        limits=(Limit(figure="peak_tree_mib", most=2048),),
        minutes=15,
    ),
)

ROWS: tuple[Row, ...] = (*REAL, *SIMULATED, *SPEED)
