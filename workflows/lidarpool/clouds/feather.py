"""Feather (Arrow IPC), a single file, through pyarrow."""

from __future__ import annotations

from pathlib import Path

from lidarsim.columns.sweep import Sweep

from .cloud_format import CloudFormat
from .recording import Recording, RecordingSource, sweep_from_columns
from .writing import ExportSpec


class Feather(CloudFormat):
    """A table with the positions and all columns of a cloud."""

    title = "Feather"
    for_scenes = True

    def write(self, path: Path, spec: ExportSpec) -> None:
        """Write the file."""
        import pyarrow as pa

        schema = None
        with pa.OSFile(str(path), "wb") as file:
            for chunk in self.cloud.chunks():
                batch = pa.RecordBatch.from_pydict(dict(chunk.by_name))
                if schema is None:
                    schema = batch.schema
                    writer = pa.ipc.new_file(file, schema)
                writer.write_batch(batch)
            if schema is not None:
                writer.close()

    @classmethod
    def open(cls, source: RecordingSource) -> Recording:
        """Open a file in its record batches."""
        import pyarrow as pa

        reader = pa.ipc.open_file(pa.memory_map(str(source.path)))

        def read(number: int) -> Sweep:
            batch = reader.get_batch(number)
            return sweep_from_columns({n: batch[n].to_numpy() for n in batch.schema.names})

        return source.recording(reader.num_record_batches, read, is_cloud=True)
