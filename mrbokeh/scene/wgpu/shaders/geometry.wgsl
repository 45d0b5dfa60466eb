// What every shader knows of a scene: triangles, materials, textures. Mirrors packed_scene.py and _surface_numba.py.

// What a scene does not have is left out when a pipeline is made: processors that stand in for a graphics device (llvmpipe)
// run both sides of every branch.
override TEXTURED = true;
override SEE_THROUGH = true;  // something is cut out or blended

const OPAQUE = 0u;
const MASK = 1u;
const CLAMP = 1u;
const MIRROR = 2u;
const PER_TRIANGLE = 15u;  // vec4: 3 corners, 3 normals, 3 tangents, 3 texture coordinates, 3 colours
const TEXEL_ROW = 2048u;

struct Material {
    base_color: vec4f,
    emissive: vec3f, normal_scale: f32,
    f0: vec3f, f90: f32,
    metallic: f32, roughness: f32, occlusion_strength: f32, alpha_cutoff: f32,
    alpha_mode: u32, double_sided: u32, unlit: u32, base_texture: i32,
    textures: vec4i,  // metallic and roughness, emissive, normal, occlusion; -1: none
}

struct Texture {
    start: u32, width: u32, height: u32, levels: u32,
    wrap_s: u32, wrap_t: u32, uv_set: u32, unused: u32,
    s_from_uv: vec4f, t_from_uv: vec4f,
}

// Where a ray meets a triangle: weights of its corners, depth in lengths of the ray.
struct Hit { weights: vec3f, depth: f32 }

@group(0) @binding(0) var<storage, read> triangles: array<vec4f>;
@group(0) @binding(1) var<storage, read> materials: array<Material>;
@group(0) @binding(2) var<storage, read> textures: array<Texture>;
@group(0) @binding(3) var texels: texture_2d_array<f32>;

fn unit(a: vec3f) -> vec3f {
    let squared = dot(a, a);
    return select(a, a * inverseSqrt(squared), squared > 0.0);
}

fn mixed3(a: vec3f, b: vec3f, c: vec3f, w: vec3f) -> vec3f { return w.x * a + w.y * b + w.z * c; }

fn mixed4(a: vec4f, b: vec4f, c: vec4f, w: vec3f) -> vec4f { return w.x * a + w.y * b + w.z * c; }

// Moeller and Trumbore 1997; weights are not clamped.
fn meet(a: vec3f, b: vec3f, c: vec3f, origin: vec3f, ray: vec3f) -> Hit {
    let side_1 = b - a;
    let side_2 = c - a;
    let to_origin = origin - a;
    let p = cross(ray, side_2);
    let q = cross(to_origin, side_1);
    let determinant = dot(p, side_1);
    if determinant == 0.0 {
        return Hit(vec3f(1.0, 0.0, 0.0), 0.0);
    }
    let w1 = dot(p, to_origin) / determinant;
    let w2 = dot(q, ray) / determinant;
    return Hit(vec3f(1.0 - w1 - w2, w1, w2), dot(q, side_2) / determinant);
}

fn clamped(w: vec3f) -> vec3f {
    let w1 = clamp(w.y, 0.0, 1.0);
    let w2 = clamp(w.z, 0.0, 1.0 - w1);
    return vec3f(1.0 - w1 - w2, w1, w2);
}

fn wrapped(index: i32, size: i32, wrap: u32) -> i32 {
    if wrap == CLAMP {
        return clamp(index, 0, size - 1);
    }
    if wrap == MIRROR {
        let folded = ((index % (2 * size)) + 2 * size) % (2 * size);
        return min(folded, 2 * size - 1 - folded);
    }
    return ((index % size) + size) % size;
}

fn texel(index: u32) -> vec4f {
    let layer_rows = textureDimensions(texels).y;
    let line = index / TEXEL_ROW;
    return textureLoad(texels, vec2u(index % TEXEL_ROW, line % layer_rows), line / layer_rows, 0);
}

// A texture at uv (two sets) where it has about one texel per ray; footprint: width in each set's coordinates.
fn read_texture(number: i32, uv: vec4f, footprint: vec2f) -> vec4f {
    let texture = textures[number];
    let own = select(uv.xy, uv.zw, texture.uv_set == 1u);
    let st = vec2f(dot(texture.s_from_uv.xy, own) + texture.s_from_uv.z, dot(texture.t_from_uv.xy, own) + texture.t_from_uv.z);
    let stretch = abs(texture.s_from_uv.x * texture.t_from_uv.y - texture.s_from_uv.y * texture.t_from_uv.x);
    let width = select(footprint.x, footprint.y, texture.uv_set == 1u);
    let detail = width * sqrt(f32(texture.width) * f32(texture.height) * stretch);
    let level = clamp(log2(max(detail, 1.0)), 0.0, f32(texture.levels - 1u));
    var start = texture.start;
    var size = vec2u(texture.width, texture.height);
    for (var k = 0u; k < u32(level); k++) {
        start += size.x * size.y;
        size = max(size / 2u, vec2u(1u));
    }
    // Four texels of the finer level and, between two levels, four of the coarser; a loop, for it is compiled many times over.
    var sum = vec4f(0.0);
    let count = select(4u, 8u, fract(level) > 0.0);
    for (var k = 0u; k < count; k++) {
        if k == 4u {
            start += size.x * size.y;
            size = max(size / 2u, vec2u(1u));
        }
        let at = st * vec2f(size) - 0.5;
        let corner = vec2u(k & 1u, (k >> 1u) & 1u);
        let f = fract(at);
        let weight = select(1.0 - f, f, corner == vec2u(1u));
        let x = wrapped(i32(floor(at.x)) + i32(corner.x), i32(size.x), texture.wrap_s);
        let y = wrapped(i32(floor(at.y)) + i32(corner.y), i32(size.y), texture.wrap_t);
        let share = weight.x * weight.y * select(1.0 - fract(level), fract(level), k >= 4u);
        sum += share * texel(start + u32(y) * size.x + u32(x));
    }
    return sum;
}

// Factor times texture times vertex colour; alpha is how much it covers under the material's alpha mode.
fn base_color(material: Material, tint: vec4f, uv: vec4f, footprint: vec2f) -> vec4f {
    var base = material.base_color * tint;
    if TEXTURED && material.base_texture >= 0 {
        base *= read_texture(material.base_texture, uv, footprint);
    }
    if !SEE_THROUGH || material.alpha_mode == OPAQUE {
        base.a = 1.0;
    } else if material.alpha_mode == MASK {
        base.a = select(0.0, 1.0, base.a >= material.alpha_cutoff);
    }
    base.a = clamp(base.a, 0.0, 1.0);
    return base;
}
