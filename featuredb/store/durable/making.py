"""How tables are made, and what their Parquet files are written like."""

import json

from deltalake import ColumnProperties, DeltaTable, WriterProperties

from featuredb.store.tables import FORMAT_VERSION, TableSpec

# The log is the history that `as_of` reads; it is small, so it is kept until `vacuum` is told otherwise.
LOG_RETENTION = "interval 36500 days"


def create_table(url: str, spec: TableSpec, storage_options: dict[str, str] | None) -> None:
    """Make an empty table; harmless where there is one."""
    DeltaTable.create(
        url,
        spec.schema,
        mode="ignore",
        partition_by=list(spec.partition_by) or None,
        name=f"featuredb.{spec.name}",
        description=description(),
        configuration={
            "delta.logRetentionDuration": LOG_RETENTION,
            "delta.dataSkippingStatsColumns": ",".join(spec.statistics),
        },
        storage_options=storage_options,
    )


def description() -> str:
    """What a table says about its format."""
    return json.dumps({"featuredb_format": FORMAT_VERSION})


def writer_properties(spec: TableSpec) -> WriterProperties:
    """Compression, row groups and encodings."""
    # Lengths apart from bytes: 128-byte descriptors take 108 bytes a row instead of 111, and write faster.
    plain = ColumnProperties(dictionary_enabled=False, encoding="DELTA_LENGTH_BYTE_ARRAY")
    return WriterProperties(
        compression="ZSTD",
        max_row_group_size=spec.row_group_rows,
        column_properties=dict.fromkeys(spec.plain_bytes, plain) or None,
    )
