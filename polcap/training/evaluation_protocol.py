"""The evaluation protocol: fixed pictures of the test meshes (6) with the test materials (30), as cues and truth.

Protocol 1: diffuse light leaves through a smooth interface, and half of the materials have a high F0. Protocol 2: it
leaves through facets of the gloss's roughness (`optics/body.py`), and F0 is that of everyday objects. Shapes, patterns
and cameras are the same. A picture follows from its number, at any size. `CONDITIONS` states the camera.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from polcap.chart_values import ColorCalibration
from polcap.image_values import Bits, Bools, Floats, Quality, View
from polcap.optics import frames, resize
from polcap.optics.body import SMOOTH, Law
from polcap.optics.mesh_tracer import Tracer, Triangles, centred
from polcap.stage_values import Cues, StokesImage, SurfaceMaps
from polcap.stages import cues
from polcap.training import evaluation_materials, light_transport, random_shapes, traced_views
from polcap.training.camera_errors import CameraErrors, photograph

VERSION = 1  # to be raised when a number gives other pixels
COUNT, SIZE = 250, 512  # pictures, px
QUICK_COUNT, QUICK_SIZE = 50, 256
LIGHTS = 20  # of the rendering error
_SEED = 20211121
_FIELD_OF_VIEW = 30.0  # degrees, of the side of the picture
FLASH = 0.05  # of the distance, above the lens
_REDUCED = 160  # px: approximate size for the comparison of networks alone
CONDITIONS = (
    "three exposures ×4 apart of a sensor with a full well of 20 ke⁻ and read noise 5 e⁻; gain error 0.3 % per shot "
    "(1σ); polarizer angle error 0.5° (1σ); flash 5 cm above the lens at 1 m distance; field of view 30°, object "
    "over 70–90 % of it; refractive index 1.4–1.6; cast shadows and one diffuse bounce between parts of the object, "
    "traced; seeds fixed"
)
PROTOCOLS = {1: "smooth bodies, F0 .03–.26", 2: "rough bodies, F0 as it is met"}


@dataclass(frozen=True)
class Case:
    """One simulated picture of the evaluation with its truth; camera frame."""

    name: str  # mesh and material
    cues: Cues  # with the camera errors of CONDITIONS
    clean: Cues  # without camera errors, in the same light
    small: Cues  # `cues` binned to about the size of training pictures
    truth: SurfaceMaps
    depth: Floats  # (H, W) true depth, units of traced_views.depth_unit, mean 0


@dataclass(frozen=True)
class _Subject:
    """Geometry and material of one evaluation picture, before light is simulated."""

    pose: light_transport.LitPose
    places: light_transport.SurfacePoints
    albedo: light_transport.Albedo
    truth: SurfaceMaps
    depth: Floats  # of the truth


class Protocol:
    """All evaluation pictures of one size and protocol."""

    def __init__(self, data: Path, size: int, protocol: int = 1) -> None:
        files = traced_views.test_meshes(data)
        self.size, self.protocol = size, protocol
        self.names = [file.stem for file in files]
        self.tracers = [Tracer(centred(traced_views.read_mesh(file))) for file in files]
        self.materials = evaluation_materials.test_materials(data / "materials" / "test", everyday=protocol == 2)

    def case(self, number: int) -> Case:
        """Simulate the evaluation picture with this number."""
        subject = self._subject(number, self.size)
        mesh, material = combination(number, len(self.names), len(self.materials))
        rng = np.random.default_rng([_SEED, number, 1])
        light = light_transport.stokes(self.tracers[mesh], subject.places, subject.pose, subject.albedo, rng)
        with torch.random.fork_rng():
            torch.manual_seed(_SEED + number)
            stated, clean = (
                _photograph(light, subject.places, subject.truth.view, errors(1, torch.device("cpu")))
                for errors in (CameraErrors.stated, CameraErrors.none)
            )
        return Case(
            name=f"{self.names[mesh]}, {self.materials[material].name}",
            cues=cues.compute(stated, white()),
            clean=cues.compute(clean, white()),
            small=cues.compute(_bin(stated, max(1, round(self.size / _REDUCED))), white()),
            truth=subject.truth,
            depth=subject.depth,
        )

    @property
    def subjects(self) -> str:
        """Number of test meshes and test materials, in words."""
        return f"{len(self.names)} test meshes × {len(self.materials)} test materials"

    def truth(self, number: int, size: int) -> SurfaceMaps:
        """True maps of an evaluation picture, without simulating light."""
        return self._subject(number, size).truth

    def _subject(self, number: int, size: int) -> _Subject:
        """Place, trace and cover the mesh of an evaluation picture."""
        index, which = combination(number, len(self.names), len(self.materials))
        tracer, material = self.tracers[index], self.materials[which]
        rng = np.random.default_rng([_SEED, number])
        focal = size / 2 / np.tan(np.radians(_FIELD_OF_VIEW / 2))
        view = View(focal=float(focal), center=((size - 1) / 2, (size - 1) / 2), scale=1.0)
        while True:
            turn, translation = _random_placement(tracer.mesh, rng)
            buffer = tracer.trace(turn, translation, view, size, size)
            if buffer.mask.mean() > traced_views.LEAST_SHARE:
                break
        inside = buffer.mask
        middle, unit = traced_views.depth_unit(inside, buffer.depth, view.focal)
        pose = light_transport.LitPose(turn, translation, np.array([0, FLASH * middle, 0]), middle**2)
        frame, shift = random_shapes.rotation(rng), rng.uniform(-0.5, 0.5, 3)  # of the material's pattern
        position, v = buffer.position[inside].astype(np.float64), frames.rays(view, size, size)[inside]

        def albedo(place: Floats, facing: Floats) -> Floats:
            return material.at(place @ frame.T + shift, facing @ frame.T).diffuse

        normal = buffer.normal[inside]
        pattern = position @ frame.T + shift, normal @ turn @ frame.T  # in that frame
        sample, slope = material.at(*pattern), material.slope(*pattern) @ frame @ turn.T
        tilted = np.asarray(frames.lifted(frames.to_ray_frame(frames.tilted(normal, slope), v)))
        _, flat = tracer.first_hits(position + 0.01 * (v @ turn), -v @ turn)  # from just in front of the surface
        law = body_law(number) if self.protocol == 2 else SMOOTH
        places = light_transport.SurfacePoints(
            inside, position, flat, tilted, v, sample.diffuse, sample.specular, sample.roughness, material.ior, law
        )
        normal, diffuse, specular, roughness, depth = (
            traced_views.fill(inside, values)
            for values in (
                np.asarray(frames.from_ray_frame(tilted, v)), sample.diffuse, sample.specular, sample.roughness,
                (buffer.depth[inside] - middle) / unit,
            )
        )  # fmt: skip
        confidence = np.zeros(inside.shape, np.float32)
        truth = SurfaceMaps(normal, diffuse, specular, roughness, depth, confidence, inside, view, "truth")
        return _Subject(pose, places, albedo, truth, depth)


def combination(number: int, meshes: int, materials: int) -> tuple[int, int]:
    """Indices of mesh and material of an evaluation picture.

    With 6 meshes and 30 materials, the first 30 pictures show each material once and each mesh 5 times. All pairs are
    shown by `meshes` × `materials` pictures.
    """
    order = np.random.default_rng(_SEED).permutation(materials)
    mesh = number % meshes
    return mesh, int(order[(number // meshes + 5 * mesh) % len(order)])


def body_law(number: int) -> Law:
    """Parameters of diffuse polarization in a picture of protocol 2.

    Facets have equal weights in even pictures, and are weighted by the flash's light in odd ones. The factor on the
    polarization is 0.8–1, in every tenth picture 0.4–0.8.
    """
    low, high = (0.4, 0.8) if number % 10 == 9 else (0.8, 1.0)
    factor = np.random.default_rng([_SEED, number, 2]).uniform(low, high)
    return Law(rough=1.0, local=float(number % 2), dolp_factor=float(factor))


def render_lights() -> Floats:
    """Directions to the 20 lights of the re-rendering error (20, 3). Evenly within 60° of the camera."""
    k = np.arange(LIGHTS) + 0.5
    z, azimuth = 1 - k / LIGHTS * (1 - np.cos(np.radians(60))), np.pi * (3 - np.sqrt(5)) * k
    across = np.sqrt(1 - z**2)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), z], axis=1)


def stokes_image(measured: tuple[Tensor, Tensor, Tensor], mask: Bools, view: View) -> StokesImage:
    """Build a `StokesImage` from Stokes parameters, covariance and clipped flags measured at the pixels of `mask`."""
    stokes, covariance = (np.stack([traced_views.fill(mask, one) for one in part.numpy()]) for part in measured[:2])
    quality: Bits = np.zeros(mask.shape, dtype=np.uint8)
    quality[mask] = measured[2].numpy() * np.uint8(Quality.CLIPPED)
    return StokesImage(stokes, covariance, quality, mask, view, None)


def _random_placement(mesh: Triangles, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Random rotation, and translation along the optical axis: the object fills 70–90 % of the picture's side."""
    turn, fill = random_shapes.rotation(rng), rng.uniform(0.7, 0.9)
    seen = mesh.vertices.astype(np.float64) @ turn.T
    seen -= (middle := (seen.min(axis=0) + seen.max(axis=0)) / 2)
    slope = fill * np.tan(np.radians(_FIELD_OF_VIEW / 2))
    distance = float((np.abs(seen[:, :2]).max(axis=1) / slope + seen[:, 2]).max())
    return turn, np.array([0, 0, -distance]) - middle


def _photograph(light: Floats, places: light_transport.SurfacePoints, view: View, errors: CameraErrors) -> StokesImage:
    """Measure Stokes parameters (3, M, 3) with a camera that has these errors."""
    mask = places.mask
    images = np.stack([traced_views.fill(mask, part) for part in light]), traced_views.fill(mask, places.diffuse)
    scene, diffuse = (torch.from_numpy(image) for image in images)
    inside, rays = (torch.from_numpy(image)[None] for image in (mask, frames.rays(view, *mask.shape)))
    measured = photograph(scene[:, None], diffuse[None], inside, rays, torch.from_numpy(np.flatnonzero(mask)), errors)
    return stokes_image(measured, mask, view)


def _bin(image: StokesImage, by: int) -> StokesImage:
    """Reduce a Stokes image: means over by × by pixels. A new pixel is on the object if half of its pixels are."""
    inside = image.mask.astype(np.float32)
    share = resize.block_means(inside, by)
    mask, least = share >= 0.5, np.maximum(share, 1 / by**2)[..., None]

    def object_means(layers: Floats) -> Floats:
        return np.asarray([resize.block_means(layer * inside[..., None], by) / least for layer in layers])

    stokes, covariance = object_means(image.stokes), object_means(image.covariance) / (least * by**2)
    clipped = resize.block_means(((image.quality & Quality.CLIPPED) > 0) * inside, by) * 2 > share
    view = replace(
        image.view, focal=image.view.focal / by, scale=by,
        center=((image.view.center[0] + 0.5) / by - 0.5, (image.view.center[1] + 0.5) / by - 0.5),
    )  # fmt: skip
    quality = clipped.astype(np.uint8) * np.uint8(Quality.CLIPPED)
    return StokesImage(stokes * mask[..., None], covariance * mask[..., None], quality, mask, view, None)


def white() -> ColorCalibration:
    """A color calibration that changes nothing (identity matrix)."""
    return ColorCalibration(np.eye(3, dtype=np.float32), "profile")
