"""The shaders: one source, of which each set of streams compiles only what it asks for."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import DTypeLike

from .rendering import BACKGROUND

__all__ = ["FRAGMENT", "LUMINANCE", "OUTPUTS", "VERTEX"]

LUMINANCE = (0.299, 0.587, 0.114)
"""Weights of red, green and blue (ITU-R BT.601)."""


class Output(NamedTuple):
    """How one stream is drawn."""

    type: str
    components: int
    dtype: str
    array: DTypeLike
    background: tuple[float, float, float, float]


_GREY = sum(weight * value for weight, value in zip(LUMINANCE, BACKGROUND, strict=True))

OUTPUTS = {
    "color": Output("vec4", 4, "f1", np.uint8, (*BACKGROUND, 1.0)),
    "depth": Output("float", 1, "f4", np.float32, (0.0, 0.0, 0.0, 0.0)),
    "infrared": Output("float", 1, "f1", np.uint8, (_GREY, _GREY, _GREY, _GREY)),
    # A float holds every whole number below 2^24; an integer layer cannot be cleared to -1 through moderngl.
    "segmentation": Output("float", 1, "f4", np.float32, (-1.0, -1.0, -1.0, -1.0)),
}
"""By stream; their order is that of the layers."""

VERTEX = """
#if defined(COLOR) || defined(INFRARED)
#define LIT
#endif
uniform mat4 model_view_projection;
in vec3 position;
#ifdef LIT
uniform mat4 model_view;
in vec3 normal;
in vec4 color;
out vec3 to_eye;
out vec3 facing;
out vec3 paint;
#ifdef TEXTURED
in vec2 uv;
out vec2 place;
#endif
#endif
void main() {
    gl_Position = model_view_projection * vec4(position, 1.0);
#ifdef LIT
    to_eye = -(model_view * vec4(position, 1.0)).xyz;
    facing = mat3(model_view) * normal;
    paint = color.rgb;
#ifdef TEXTURED
    place = uv;
#endif
#endif
}
"""

FRAGMENT = """
#if defined(COLOR) || defined(INFRARED)
#define LIT
#endif
#ifdef LIT
uniform vec3 key_light;
uniform vec3 up;
in vec3 to_eye;
in vec3 facing;
in vec3 paint;
#ifdef TEXTURED
uniform sampler2D picture;
in vec2 place;
#endif
#endif
#ifdef DEPTH
uniform vec2 range;
#endif
#ifdef SEGMENTATION
uniform float body;
#endif
void main() {
#ifdef LIT
    vec3 n = normalize(facing) * (gl_FrontFacing ? 1.0 : -1.0);
    vec3 eye = normalize(to_eye);
    vec3 base = paint;
#ifdef TEXTURED
    base *= texture(picture, place).rgb;
#endif
    vec3 ambient = mix(vec3(0.34, 0.32, 0.31), vec3(0.52, 0.54, 0.57), 0.5 + 0.5 * dot(n, up));
    float key = 0.36 * max(dot(n, key_light), 0.0);
    float head = 0.12 * max(dot(n, eye), 0.0);
    float gloss = 0.05 * pow(max(dot(n, normalize(key_light + eye)), 0.0), 24.0);
    vec3 seen = base * (ambient + key + head) + gloss;
#endif
#ifdef COLOR
    out_color = vec4(seen, 1.0);
#endif
#ifdef INFRARED
    out_infrared = dot(seen, vec3(0.299, 0.587, 0.114));
#endif
#ifdef DEPTH
    float z = 1.0 / gl_FragCoord.w;
    out_depth = z >= range.x && z <= range.y ? z : 0.0;
#endif
#ifdef SEGMENTATION
    out_segmentation = body;
#endif
}
"""
