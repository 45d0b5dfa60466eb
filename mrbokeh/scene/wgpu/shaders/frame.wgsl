// What the shading of a picture is given and what it writes.

override LIT_BY_LIGHTS = true;
override LIT_BY_PANORAMA = true;
override CATCHER = false;  // materials are those of the casters then, not of what is drawn
override LAYERED = true;  // see-through surfaces come in layers, front to back

const SAMPLES = 16u;
const EVERY_SAMPLE = 0xffffu;
const AT_CENTRE = 16u;
const LARGEST_TURN_COSINE = 0.877582562;  // of 0.5 rad, as in pixel_edges.py
const DEPTH_STEP = 0.02;
const NOTHING_LEFT = 0.0009765625;
const LIT_STEP = 0.02;
const NOT_PLAIN = 2.0;  // stands for a share of light where it was not looked at
const LISTED = 16u;  // where the lists of `work` begin

struct Frame {
    eye: vec3f, footprint: f32,              // footprint: width of a pixel at unit depth
    right: vec3f, step: f32,                 // step: what keeps shadow rays off the surface where they start, metres
    down: vec3f, light_count: u32,
    forward: vec3f, unused_1: u32,
    focal: vec2f, principal: vec2f,
    caster_from_point: vec3f, veils: u32,    // triangles and casters count from centres of their own
    size: vec2u, layer: u32, is_last: u32,   // the last layer is what is solid
    samples: array<vec4f, 16>,               // xy in the pixel; z, w: the texel beside it that holds the sample
}


@group(1) @binding(0) var<uniform> frame: Frame;
@group(1) @binding(6) var<storage, read_write> rgba: array<vec4f>;
// The surface that decides each pixel's depth (and its sample, from bit 27 on); behind all of these, floats: its share of light.
@group(1) @binding(7) var<storage, read_write> pixels: array<u32>;
@group(1) @binding(8) var<storage, read_write> shines_through: array<f32>;
// Word 0 and 4: sizes of the lists of plain and of edge pixels, as thread groups in words 1 to 3 and 5 to 7; then the lists.
@group(1) @binding(9) var<storage, read_write> work: array<atomic<u32>>;
@group(1) @binding(10) var seen_centre: texture_2d<u32>;
@group(1) @binding(11) var seen_0: texture_multisampled_2d<u32>;
@group(1) @binding(12) var seen_1: texture_multisampled_2d<u32>;
@group(1) @binding(13) var seen_2: texture_multisampled_2d<u32>;
@group(1) @binding(14) var seen_3: texture_multisampled_2d<u32>;

fn ray_through(at: vec2f) -> vec3f {
    let plane = (at - frame.principal) / frame.focal;
    return plane.x * frame.right + plane.y * frame.down + frame.forward;
}
