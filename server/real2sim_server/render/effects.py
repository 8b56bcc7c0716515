"""What a real camera does to colour images, after they are drawn.

Light is linear: display values are taken apart by the curve of sRGB and put together by it again.
"""

from __future__ import annotations

import functools
import zlib

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.cameras import CameraEffects, NoiseSpec

from .encode import encode_rgb

Light = NDArray[np.float32]
STEPS = 1 << 14
"""Of the table that gives display values to light."""


def with_effects(
    rgb: NDArray[np.uint8], effects: CameraEffects, camera: str, t_us: int
) -> NDArray[np.uint8]:
    """An image [H, W, 3] as the camera gives it; motion blur has been drawn already.

    Args:
        rgb: as drawn.
        effects: of the camera.
        camera: its name; noise differs between cameras and instants.
        t_us: instant [us].
    """
    light = to_light(rgb)
    if effects.vignetting is not None:
        light *= _falloff(rgb.shape[:2], effects.vignetting)[..., None]
    gains = np.array(effects.white_balance or (1.0, 1.0, 1.0)) * 2.0**effects.exposure_ev
    light *= gains.astype(np.float32)
    if effects.noise is not None:
        light += _noise(light, effects.noise, camera, t_us)
    image = to_display(light, None if effects.tone_curve is None else tuple(effects.tone_curve))
    if effects.jpeg_quality is not None:
        image = _through_jpeg(image, effects.jpeg_quality)
    return image


def to_light(rgb: NDArray[np.uint8]) -> Light:
    """Linear light, 1 for white."""
    return _light_of_levels()[rgb]


def to_display(light: Light, tone_curve: tuple[float, ...] | None = None) -> NDArray[np.uint8]:
    """Display values of linear light, cut at black and white."""
    index = np.clip(light * (STEPS - 1) + 0.5, 0, STEPS - 1).astype(np.uint16)
    levels: NDArray[np.uint8] = _levels_of_light(tone_curve)[index]
    return levels


@functools.cache
def _light_of_levels() -> Light:
    value = np.arange(256) / 255
    light = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return light.astype(np.float32)


@functools.lru_cache(maxsize=64)
def _levels_of_light(tone_curve: tuple[float, ...] | None) -> NDArray[np.uint8]:
    light = np.arange(STEPS) / (STEPS - 1)
    value = np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)
    if tone_curve is not None:
        value = np.interp(value, np.linspace(0, 1, len(tone_curve)), tone_curve)
    return (np.clip(value, 0, 1) * 255 + 0.5).astype(np.uint8)


@functools.lru_cache(maxsize=16)
def _falloff(size: tuple[int, int], numbers: tuple[float, float, float]) -> Light:
    height, width = size
    y, x = np.ogrid[:height, :width]
    r2 = (x + 0.5 - width / 2) ** 2 + (y + 0.5 - height / 2) ** 2
    r2 = r2 / ((width**2 + height**2) / 4)
    a, b, c = numbers
    return np.maximum(1 + r2 * (a + r2 * (b + r2 * c)), 0).astype(np.float32)


def _noise(light: Light, noise: NoiseSpec, camera: str, t_us: int) -> Light:
    """Of a generator that counts: the same on any thread, whatever was drawn before."""
    key = np.array([noise.seed, zlib.crc32(camera.encode())], np.uint64)
    counter = np.array([0, 0, 0, t_us & (2**64 - 1)], np.uint64)
    generator = np.random.Generator(np.random.Philox(key=key, counter=counter))
    sigma = np.sqrt(noise.photon * np.maximum(light, 0) + noise.read**2)
    return (sigma * generator.standard_normal(light.shape, np.float32)).astype(np.float32)


def _through_jpeg(image: NDArray[np.uint8], quality: int) -> NDArray[np.uint8]:
    import simplejpeg

    data = encode_rgb(np.ascontiguousarray(image), "jpeg", quality=quality)
    return np.asarray(simplejpeg.decode_jpeg(data, colorspace="RGB"))
