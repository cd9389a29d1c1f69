"""Tables in Parquet files, read in batches of rows by pyarrow."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from estimator.can_io.logs.table_piece import ROWS, Piece, Wanted
from estimator.errors import LogError
from estimator.extras import how_to_install

MAX_CHUNK = 1 << 28  # bytes of a column of a row group, unpacked: pages of it are unpacked as a whole


def read(path: Path, wanted: Wanted) -> Iterator[Piece]:
    """Pieces of a Parquet file, of the wanted columns only.

    Raises
    ------
    LogError
        pyarrow is missing, or the file is damaged, or would unpack to too much at once.
    """
    try:
        from pyarrow import ArrowException
        from pyarrow.parquet import ParquetFile
    except ImportError as error:
        raise LogError(f"{path}: Parquet needs pyarrow: {how_to_install('fleet')}") from error
    try:
        with ParquetFile(path) as file:
            names, total, done = file.schema_arrow.names, max(file.metadata.num_rows, 1), 0
            chosen = [name for name in names if name in wanted(names)]
            _check_size(path, file.metadata, chosen)
            for batch in file.iter_batches(ROWS, columns=chosen, use_threads=False):
                done += batch.num_rows
                cells = {name: batch.column(name).to_numpy(zero_copy_only=False) for name in chosen}
                yield Piece(cells, done / total)
    except (ArrowException, OSError) as error:
        reason = " ".join(str(error).split())
        raise LogError(f"{path}: cannot be read as Parquet ({reason}); copy it anew") from error


def _check_size(path: Path, metadata: Any, chosen: list[str]) -> None:
    """Refuse columns whose row groups do not fit into memory."""
    for group in map(metadata.row_group, range(metadata.num_row_groups)):
        if group.total_byte_size <= MAX_CHUNK:
            continue  # a damaged description of a column ends the process, so none is looked at without need
        for column in map(group.column, range(metadata.num_columns)):
            if column.path_in_schema in chosen and column.total_uncompressed_size > MAX_CHUNK:
                raise LogError(
                    f"{path}: column {column.path_in_schema!r} unpacks to {column.total_uncompressed_size >> 20:,} MiB "
                    f"in one row group; write it in row groups of less than {MAX_CHUNK >> 20} MiB"
                )
