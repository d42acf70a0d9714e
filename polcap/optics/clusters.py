"""Groups of like colors, as a sign of one material."""

import cv2
import numpy as np

from polcap.image_values import Floats

_LEAST_SPREAD = 0.02  # within a group; it divides
_MOST = 40_000  # of twice as many colors or more, only every n-th is grouped


def color_clusters(encoded: Floats, count: int) -> tuple[Floats, float]:
    """Centers (G, C) of at most `count` groups of sRGB-encoded colors (N, C), and the spread within a group.

    Features other than color may be added; their scale is their weight.
    """
    sample = np.ascontiguousarray(encoded[:: max(1, len(encoded) // _MOST)], np.float32)
    stop = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-4)
    cv2.setRNGSeed(0)
    compactness, _, center = cv2.kmeans(
        sample, min(count, len(sample)), np.empty(0, np.int32), stop, 3, cv2.KMEANS_PP_CENTERS
    )
    return np.asarray(center), max(float(np.sqrt(compactness / len(sample))), _LEAST_SPREAD)


def soft_share(encoded: Floats, center: Floats, spread: float) -> Floats:
    """Share (N, G) of each color (N, C) in each group; the shares of a color sum to 1."""
    distance = np.stack([np.linalg.norm(encoded - one, axis=-1) for one in center], axis=-1)
    nearest = distance.min(axis=1, keepdims=True)  # cancels in the share; without it, far colors would have 0/0
    likeness = np.exp(-((distance / spread) ** 2) + (nearest / spread) ** 2)
    return np.asarray(likeness / likeness.sum(axis=1, keepdims=True))
