"""The object's mask in a view that shows the board: found as before a dark backdrop, after the print is erased."""

from polcap.chart_values import ColorCalibration
from polcap.fusion.board_eraser import PosedBoard, erase
from polcap.fusion.values import ViewMask
from polcap.stage_values import Alignment, AngleStack, Network, RunNetwork
from polcap.stages import mask, stage
from polcap.stages.mask import MaskSettings


@stage(version=1, uses=(mask.segment,))
def find(
    radiance: AngleStack,
    alignment: Alignment,
    color: ColorCalibration,
    posed: PosedBoard,
    network: Network | None,
    run: RunNetwork,
    settings: MaskSettings,
) -> ViewMask:
    """Erase the board from a view, and find the object's mask.

    Raises ObjectError: no object is found.
    """
    erased = erase(radiance, alignment, color, posed)
    found = mask.segment(erased, alignment, color, None, network, run, settings)
    return ViewMask(found.mask, radiance.view.scale)
