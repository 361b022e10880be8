"""Where each dataset's files lie below the data folder, and where they can be had."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

PHD_UTILS = "https://raw.githubusercontent.com/souljaboy764/phd_utils/99391e032d6a708b26d5d8bde85cb0c124f0cd91"
NUISI_DATASET = "https://raw.githubusercontent.com/souljaboy764/nuisi_dataset"


@dataclass(frozen=True)
class DataFile:
    """One file of a dataset. `path` is relative to the data folder; `url` is None where nobody publishes it so."""

    path: Path
    url: str | None = None
    sha256: str | None = None
    optional: bool = False
    """The dataset can be read without it."""


@dataclass(frozen=True)
class Source:
    """The files of one dataset, and what to do where they cannot be fetched."""

    files: tuple[DataFile, ...]
    by_hand: str = ""
    """How to get the files that have no `url`."""


HANDOVERS = Source(
    (DataFile(Path("handover/train.npz")), DataFile(Path("handover/test.npz"))),
    by_hand=(
        "Its source, the GitHub repository hyeonseong-kim98/dynamic_handover_dataset, publishes one Python pickle "
        "a motion, which mild_viz does not open; no place is known that publishes the two .npz files, so there is "
        "neither an address nor a checksum to trust. Convert the motions yourself, into arrays receiver and giver "
        "(N, 34, 3) [m] in ZED body-34 order, offsets (first frame of each trial, then N) and rate_hz, and place "
        "them at"
    ),
)

SOURCES: dict[str, Source] = {
    "demo": Source(()),
    "nuisi": Source(
        (
            DataFile(
                Path("nuisi/traj_data.npz"),
                f"{PHD_UTILS}/data_preproc/nuisi/traj_data.npz",
                "ffc98d4b7006a02fc65791573d8a684cf0e80fa95032bfdd525dfdbf26a3a19b",
            ),
            # The second person's recording was published under another folder, in another commit.
            DataFile(
                Path("nuisi/raw/Rocket_p1.txt"),
                f"{NUISI_DATASET}/afde0c0be9ca77acc4babe1cc54a4cf01f0fdfed/data/Rocket_p1.txt",
                "6a71eff8f441b14e510bb89cc4a0c40b3dc33495ff066c2626f81c11448a7470",
                optional=True,
            ),
            DataFile(
                Path("nuisi/raw/Rocket_p2.txt"),
                f"{NUISI_DATASET}/360a14758027b4462db9bff3db215f4e67af2398/data_v2/Rocket_p2.txt",
                "4a355c20d6ae0bc6e5a1760e019d73d8103ac0839b1d5e4b6630cc7cc60bbda3",
                optional=True,
            ),
        )
    ),
    "yumi": Source(
        (
            DataFile(
                Path("buetepage_hr/traj_data.npz"),
                f"{PHD_UTILS}/data_preproc/buetepage_hr/traj_data.npz",
                "08adeecdcae6ea83b141f4c1bd2c00bf980457d0688581e67611e70839fe2c80",
            ),
        )
    ),
    "handover": HANDOVERS,
    "handover-hands": HANDOVERS,
    "bimanual": Source(
        (DataFile(Path("bimanual/Bimanual Handovers Dataset")),),
        by_hand=(
            "It is the record 7767535 of Zenodo, https://zenodo.org/records/7767535, whose files and checksums are not "
            "known here, and mild_viz keeps nothing that it cannot check. Download and unpack it yourself, and place "
            "its folder, with P07_P08 and so on inside, at"
        ),
    ),
    "buetepage": Source(
        (DataFile(Path("buetepage/traj_data.npz")),),
        by_hand=(
            "Its source is the GitHub repository souljaboy764/phd_utils, but the file's SHA-256 is not known here, and "
            "mild_viz keeps nothing that it cannot check. Download "
            f"{PHD_UTILS}/data_preproc/buetepage/traj_data.npz yourself and place it at"
        ),
    ),
}
"""By dataset name."""
