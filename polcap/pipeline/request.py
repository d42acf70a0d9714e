"""A request: everything that a user states besides the photographs. Commands, Python, batches and fusions share it."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from polcap.capture_values import Capture
from polcap.chart_values import ChartRequest
from polcap.config import Config
from polcap.formats.capture import reader
from polcap.image_values import Bools, Device
from polcap.pipeline import models, unchanged
from polcap.pipeline.cache import fingerprint
from polcap.pipeline.path import AUTO, UserInput


@dataclass(frozen=True)
class Request:
    """Settings and inputs of a run; the same for all captures of a batch and all views of a fusion."""

    config: Config = Config()  # noqa: RUF009 — frozen
    chart: ChartRequest = AUTO
    mask: Bools | None = None  # on the RAW pixels or on the merged picture
    estimator: models.Estimator | None = None
    model: Path | None = None  # None: the shipped one
    device: Device = "cpu"
    angles_deg: tuple[float, ...] | None = None
    clockwise: bool = False
    threads: int = 0  # 0: all
    memory_gb: float = 0.0  # 0: no limit

    def supplied(self) -> UserInput:
        """The user's inputs, with opened networks. Raises ModelError or SettingError: as `models.load_network`."""
        network, mask_network = models.load_networks(self.estimator, self.model, self.device, self.threads)
        return UserInput(self.chart, self.mask, network, mask_network)

    def read(self, folder: Path) -> Capture:
        """The capture in a folder, without its pixels. Raises CaptureError or DecodeError."""
        return reader.read(folder, self.angles_deg, self.clockwise)

    def open(self, folder: Path) -> tuple[Capture, UserInput]:
        """The capture in a folder, and the user's inputs; networks are opened while photographs are read.

        Raises InputError: a photograph, the chart or a model cannot be used.
        """
        with ThreadPoolExecutor(1) as pool:
            reading = pool.submit(self.read, folder)
            supplied = self.supplied()
            return reading.result(), supplied

    def digest(self, folder: Path, out: Path) -> str | None:
        """Digest of the request and its files for `unchanged`; None: these do not determine the result."""
        stated = replace(self, model=None, threads=0, memory_gb=0.0)  # without limits; the model is added below
        model_files = [] if self.model is None else [self.model]
        return unchanged.request([fingerprint(stated), str(self.model)], folder, out, [*model_files, *self.files()])

    def files(self) -> list[Path]:
        """Files that the settings name: the measured colors of the chart."""
        named = Path(self.config.whitebalance.chart)
        return [named] if named.is_file() else []
