"""The names of a recording and of the files with its samples beside it; quick to import."""

from pathlib import Path

RECORDING = ".rrd"
SAMPLES = ".samples.parquet"  # in place of the suffix of the recording, as is the next one
FOLDER = ".samples"
PART = ".parquet"


def whole_file(recording: Path) -> Path:
    """Return the path of the samples of a recording that has ended; ``recording`` may be that of its samples."""
    return recording.with_name(f"{_stem(recording)}{SAMPLES}")


def parts_folder(recording: Path) -> Path:
    """Return the folder of the samples of a recording that is being written, or whose recorder was killed."""
    return recording.with_name(f"{_stem(recording)}{FOLDER}")


def viewing_file(path: Path) -> Path:
    """Return the path of the recording of samples, or ``path`` if it is one."""
    return path.with_name(f"{_stem(path)}{RECORDING}")


def sample_files(recording: Path) -> list[Path]:
    """Return the files with the samples of a recording, in their order; none if there are no samples beside it."""
    if (whole := whole_file(recording)).exists():
        return [whole]
    return sorted(parts_folder(recording).glob(f"*{PART}"))


def _stem(path: Path) -> str:
    ends = (end for end in (SAMPLES, FOLDER, RECORDING) if path.name.endswith(end))
    return path.name.removesuffix(next(ends, path.suffix))
