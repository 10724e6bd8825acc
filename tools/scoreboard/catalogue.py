"""The rows: what README and docs claim, and the command that measures each claim."""

from tools.scoreboard.real_rows import REAL
from tools.scoreboard.row import Limit, Row
from tools.scoreboard.simulated_rows import SIMULATED
from tools.scoreboard.words import BRIGHTON, OUT, same

SPEED: tuple[Row, ...] = (
    Row(
        name="query-time",
        group="speed",
        form="quick",
        claim="one 12-megapixel photo of `brighton` with its GPS over Zenoh (medians)",
        commands=(
            ("featuredb.cli", "ingest", "photos", "{work}/db", BRIGHTON, "--quiet"),
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
        name="scan-memory",
        group="speed",
        form="full",
        claim="100 million points added by `lidar add`",
        commands=(("tools.lidar_memory", "--points", "100000000", "--folder", "{work}/scan", *OUT),),
        figures=same("points_per_cpu_second"),
        text="{peak_tree_mib:.0f} MiB at the peak, {cpu_seconds:.0f} s of a core",
        limits=(Limit(figure="peak_tree_mib", most=2048),),
        readme=True,
        minutes=15,
    ),
)

ROWS: tuple[Row, ...] = (*REAL, *SIMULATED, *SPEED)
