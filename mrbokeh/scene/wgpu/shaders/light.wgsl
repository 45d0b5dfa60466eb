// Light on shading points. Mirrors _lighting_numba.py, the look-ups of _environment_numba.py and Light.arriving_at.

const PI = 3.14159265358979;
const LOWEST_ROUGHNESS = 0.045;
const DIRECTIONAL = 0u;
const SPOT = 2u;

struct Surface {
    alpha: f32,
    unlit: bool,
    to_viewer: vec3f,
    face_normal: vec3f,
    normal: vec3f,
    shadow_origin: vec3f,
    base: vec3f,
    diffuse: vec3f,
    f0: vec3f, f90: f32,
    roughness: f32,
    occlusion: f32,
    emissive: vec3f,
}

// The maps of one cluster of casters; texel: width of a texel, in metres of a sun, at unit distance of a lamp.
struct Maps {
    first: i32, faces: u32, texel: f32, unused: u32,
    clip_from_point: array<mat4x4f, 6>,
}

struct Light {
    rgb: vec3f, luminance: f32,
    position: vec3f, kind: u32,
    direction: vec3f, one_over_range: f32,
    cos_outer: f32, cone_width: f32, clusters: u32, unused: u32,  // clusters: 0 where it casts no shadow
    maps: array<Maps, 2>,
}

// Light that arrives at a point, facing it and without shadows: as a share of the light's rgb.
struct Arriving { towards: vec3f, distance: f32, share: f32 }

struct Level { start: u32, height: u32, width: u32, unused: u32 }

const MOST_PEAKS = 16u;

struct Panorama {
    environment_from_world: mat3x3f,
    unused: u32, table_size: u32, level_count: u32, table_start: u32,
    irradiance: Level,
    levels: array<Level, 16>,
    peaks: array<mat3x3f, 16>,  // a column per colour
}

@group(1) @binding(1) var<uniform> panorama: Panorama;
@group(1) @binding(2) var<storage, read> panorama_values: array<f32>;

fn arriving_at(light: Light, at: vec3f) -> Arriving {
    if light.kind == DIRECTIONAL {
        return Arriving(-light.direction, 1e37, 1.0);
    }
    let offset = light.position - at;
    let distance = max(length(offset), 1e-9);
    let towards = offset / distance;
    let reached = distance * light.one_over_range;
    var share = clamp(1.0 - reached * reached * reached * reached, 0.0, 1.0) / (distance * distance);
    if light.kind == SPOT {
        let fade = clamp((dot(-towards, light.direction) - light.cos_outer) / light.cone_width, 0.0, 1.0);
        share *= fade * fade;
    }
    return Arriving(towards, distance, share);
}

// Radiance reflected from one light (glTF 2.0, appendix B.3) of irradiance 1.
fn reflected(s: Surface, towards: vec3f) -> vec3f {
    let n_l = dot(s.normal, towards);
    let half = unit(towards + s.to_viewer);
    let n_v = max(dot(s.normal, s.to_viewer), 1e-4);
    let n_h = dot(s.normal, half);
    let v_h = max(dot(s.to_viewer, half), 0.0);
    let roughness = max(s.roughness, LOWEST_ROUGHNESS);
    let alpha2 = roughness * roughness * roughness * roughness;
    // 1 - n_h**2 as a sine: exact near the peak, where the difference of two numbers near 1 is not.
    let across = cross(s.normal, half);
    let spread = dot(across, across) + alpha2 * n_h * n_h;
    let distribution = alpha2 / (PI * spread * spread);
    let visibility = 0.5 / (n_l * sqrt(n_v * n_v * (1.0 - alpha2) + alpha2) + n_v * sqrt(n_l * n_l * (1.0 - alpha2) + alpha2));
    let fresnel = s.f0 + (s.f90 - s.f0) * pow5(1.0 - v_h);
    return ((1.0 - fresnel) * s.diffuse / PI + fresnel * distribution * visibility) * n_l;
}

fn pow5(x: f32) -> f32 { return x * x * x * x * x; }

fn panorama_texel(level: Level, column: i32, row: i32) -> vec3f {
    var x = column;
    var y = row;
    let height = i32(level.height);
    let width = i32(level.width);
    if y < 0 {
        y = -1 - y;
        x += width / 2;
    } else if y >= height {
        y = 2 * height - 1 - y;
        x += width / 2;
    }
    x = ((x % width) + width) % width;
    let i = level.start + 3u * u32(y * width + x);
    return vec3f(panorama_values[i], panorama_values[i + 1u], panorama_values[i + 2u]);
}

// Longitude and polar angle of a direction, as shares of a panorama's width and height.
fn place_in_panorama(towards: vec3f) -> vec2f {
    return vec2f(atan2(towards.x, towards.z) / (2.0 * PI) + 0.5, acos(clamp(-towards.y, -1.0, 1.0)) / PI);
}

fn look_up(level: Level, place: vec2f) -> vec3f {
    let at = place * vec2f(f32(level.width), f32(level.height)) - 0.5;
    let low = floor(at);
    let x = i32(low.x);
    let y = i32(low.y);
    let f = at - low;
    let upper = mix(panorama_texel(level, x, y), panorama_texel(level, x + 1, y), f.x);
    let lower = mix(panorama_texel(level, x, y + 1), panorama_texel(level, x + 1, y + 1), f.x);
    return mix(upper, lower, f.y);
}

fn look_up_between(level: f32, place: vec2f) -> vec3f {
    let low = u32(clamp(level, 0.0, f32(panorama.level_count - 1u)));
    let fine = look_up(panorama.levels[low], place);
    let coarse = look_up(panorama.levels[min(low + 1u, panorama.level_count - 1u)], place);
    return mix(fine, coarse, clamp(level - f32(low), 0.0, 1.0));
}

fn table_entry(row: u32, column: u32) -> vec2f {
    let i = panorama.table_start + 2u * (row * panorama.table_size + column);
    return vec2f(panorama_values[i], panorama_values[i + 1u]);
}

fn reflected_share(roughness: f32, n_v: f32) -> vec2f {
    let last = panorama.table_size - 1u;
    let at = vec2f(clamp(n_v, 0.0, 1.0), roughness) * f32(last);
    let low = min(vec2u(at), vec2u(last - 1u));
    let f = at - vec2f(low);
    let upper = mix(table_entry(low.y, low.x), table_entry(low.y, low.x + 1u), f.x);
    return mix(upper, mix(table_entry(low.y + 1u, low.x), table_entry(low.y + 1u, low.x + 1u), f.x), f.y);
}

// Radiance reflected from the panorama: split sum with the light between microfacets given back; see add_environment.
fn from_environment(s: Surface) -> vec3f {
    let n_v = max(dot(s.normal, s.to_viewer), 0.0);
    let around = panorama.environment_from_world * s.normal;
    let mirrored = panorama.environment_from_world * unit(2.0 * n_v * s.normal - s.to_viewer);
    var matte_light = look_up(panorama.irradiance, place_in_panorama(around));
    for (var p = 0u; p < MOST_PEAKS; p++) {
        matte_light += max(around * panorama.peaks[p], vec3f(0.0));
    }
    let level = select(pow(s.roughness, 2.0 / 3.0), 0.0, s.roughness <= 0.0) * f32(panorama.level_count - 1u);
    let mirror_light = look_up_between(level, place_in_panorama(mirrored));
    let share = reflected_share(s.roughness, n_v);
    let missing = 1.0 - share.x - share.y;
    let single = s.f0 * share.x + s.f90 * share.y;
    let average = s.f0 + (s.f90 - s.f0) / 21.0;
    let multiple = missing * single * average / (1.0 - average * missing);
    let matte = s.diffuse * (1.0 - single - multiple);
    return (single * mirror_light + (multiple + matte) * matte_light) * s.occlusion;
}
