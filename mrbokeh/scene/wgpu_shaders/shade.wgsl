// Colour, coverage and the surface that decides the depth of every pixel, from the triangles that its samples see.

const SAMPLES = 16u;
const EVERY_SAMPLE = 0xffffu;
const AT_CENTRE = 16u;
const LARGEST_TURN_COSINE = 0.877582562;  // of 0.5 rad, as in pixel_edges.py
const DEPTH_STEP = 0.02;
const NOTHING_LEFT = 0.0009765625;

struct Frame {
    eye: vec3f, footprint: f32,              // footprint: width of a pixel at unit depth
    right: vec3f, step: f32,                 // step: what keeps shadow rays off the surface where they start, metres
    down: vec3f, light_count: u32,
    forward: vec3f, has_panorama: u32,
    focal: vec2f, principal: vec2f,
    caster_from_point: vec3f, veils: u32,    // triangles and casters count from centres of their own
    size: vec2u, layer: u32, layered: u32,   // layered: see-through surfaces come in layers, front to back
    samples: array<vec4f, 16>,               // xy in the pixel; z, w: the texel beside it that holds the sample
}


@group(1) @binding(0) var<uniform> frame: Frame;
@group(1) @binding(6) var<storage, read_write> rgba: array<vec4f>;
@group(1) @binding(7) var<storage, read_write> deciding: array<u32>;
@group(1) @binding(8) var<storage, read_write> shines_through: array<f32>;
@group(1) @binding(9) var seen_centre: texture_2d<u32>;
@group(1) @binding(10) var seen_0: texture_multisampled_2d<u32>;
@group(1) @binding(11) var seen_1: texture_multisampled_2d<u32>;
@group(1) @binding(12) var seen_2: texture_multisampled_2d<u32>;
@group(1) @binding(13) var seen_3: texture_multisampled_2d<u32>;

fn ray_through(at: vec2f) -> vec3f {
    let plane = (at - frame.principal) / frame.focal;
    return plane.x * frame.right + plane.y * frame.down + frame.forward;
}

fn seen_by(pixel: vec2u, sample: u32) -> u32 {
    let at = pixel + vec2u(frame.samples[sample].zw);
    let number = i32(sample % 4u);
    var halves: vec4u;
    switch sample / 4u {
        case 0u: { halves = textureLoad(seen_0, at, number); }
        case 1u: { halves = textureLoad(seen_1, at, number); }
        case 2u: { halves = textureLoad(seen_2, at, number); }
        default: { halves = textureLoad(seen_3, at, number); }
    }
    return halves.x | (halves.y << 16u);
}

fn corner_of(id: u32, number: u32) -> vec4f { return triangles[(id - 1u) * PER_TRIANGLE + number]; }

fn face_of(id: u32) -> vec3f {
    let a = corner_of(id, 0u).xyz;
    return unit(cross(corner_of(id, 1u).xyz - a, corner_of(id, 2u).xyz - a));
}

fn plane_depth(id: u32, ray: vec3f) -> f32 {
    let face = face_of(id);
    return dot(face, corner_of(id, 0u).xyz - frame.eye) / dot(face, ray);
}

// Whether two triangles show one smooth surface, so that a pixel of both needs one colour only (pixel_edges.py).
fn alike(one: u32, other: u32, at: vec2f) -> bool {
    if corner_of(one, 1u).w != corner_of(other, 1u).w {
        return false;
    }
    let ray = ray_through(at);
    let here = plane_depth(one, ray);
    let there = plane_depth(other, ray);
    let turn = abs(dot(face_of(one), face_of(other)));
    return turn > LARGEST_TURN_COSINE && abs(here - there) < DEPTH_STEP * min(here, there);
}

fn mapped_normal(material: Material, first: u32, smooth_normal: vec3f, facing: f32, w: vec3f, uv: vec4f, footprint: vec2f) -> vec3f {
    if material.normal_texture < 0 {
        return smooth_normal;
    }
    var along = mixed3(triangles[first + 6u].xyz, triangles[first + 7u].xyz, triangles[first + 8u].xyz, w);
    along -= dot(smooth_normal, along) * smooth_normal;
    if dot(along, along) < 1e-20 {
        return smooth_normal;
    }
    let read = 2.0 * read_texture(material.normal_texture, uv, footprint).xyz - 1.0;
    // `smooth_normal` is already on the viewer's side, while the tangent frame belongs to the front.
    let tilt = material.normal_scale * facing;
    along = unit(along);
    let across = cross(smooth_normal, along) * triangles[first + 6u].w * facing;
    return unit(mixed3(along, across, smooth_normal, vec3f(read.x * tilt, read.y * tilt, read.z)));
}

// From a ray and the triangle it meets to a shading point: fill_surfaces of _surface_numba.py.
fn surface_at(id: u32, ray: vec3f, pixel_share: f32) -> Surface {
    let first = (id - 1u) * PER_TRIANGLE;
    let a = triangles[first].xyz;
    let b = triangles[first + 1u].xyz;
    let c = triangles[first + 2u].xyz;
    let hit = meet(a, b, c, frame.eye, ray);
    let w = clamped(hit.weights);
    let material = materials[u32(triangles[first].w)];
    let face = cross(b - a, c - a);
    let facing = select(-1.0, 1.0, dot(face, ray) < 0.0);
    var s: Surface;
    s.to_viewer = unit(-ray);
    s.face_normal = unit(face) * facing;
    let uv = mixed4(triangles[first + 9u], triangles[first + 10u], triangles[first + 11u], w);
    let tint = mixed4(triangles[first + 12u], triangles[first + 13u], triangles[first + 14u], w);
    let width = frame.footprint * pixel_share * hit.depth / sqrt(max(dot(s.face_normal, s.to_viewer), 0.05));
    let footprint = width * vec2f(triangles[first + 3u].w, triangles[first + 4u].w);
    let base = base_color(material, tint, uv, footprint);
    // What a mask cuts out was already left out when the samples were taken.
    s.alpha = select(base.a, 1.0, material.alpha_mode == MASK);
    s.base = base.rgb;
    let n0 = triangles[first + 3u].xyz;
    let n1 = triangles[first + 4u].xyz;
    let n2 = triangles[first + 5u].xyz;
    let smooth_normal = unit(mixed3(n0, n1, n2, w)) * facing;
    s.normal = mapped_normal(material, first, smooth_normal, facing, w, uv, footprint);
    // Shadow rays start on the smooth surface that the triangles stand for (Hanika 2021, "Hacking the Shadow Terminator").
    let point = mixed3(a, b, c, w);
    let below = min(vec3f(0.0), facing * vec3f(dot(point - a, n0), dot(point - b, n1), dot(point - c, n2)));
    s.shadow_origin = point - facing * mixed3(n0, n1, n2, w * below);
    var metallic = material.metallic;
    s.roughness = material.roughness;
    if material.metallic_roughness_texture >= 0 {
        let read = read_texture(material.metallic_roughness_texture, uv, footprint);
        metallic *= read.b;
        s.roughness *= read.g;
    }
    s.roughness = clamp(s.roughness, 0.0, 1.0);
    s.emissive = material.emissive;
    if material.emissive_texture >= 0 {
        s.emissive *= read_texture(material.emissive_texture, uv, footprint).rgb;
    }
    s.occlusion = 1.0;
    if material.occlusion_texture >= 0 {
        s.occlusion += material.occlusion_strength * (read_texture(material.occlusion_texture, uv, footprint).r - 1.0);
    }
    s.diffuse = s.base * (1.0 - metallic);
    s.f0 = material.f0 * (1.0 - metallic) + s.base * metallic;
    s.f90 = material.f90 + metallic * (1.0 - material.f90);
    s.unlit = material.unlit == 1u;
    return s;
}

// Mean visibility of a light over the samples of a mask: all sixteen only where a few of them disagree.
fn lit_share(number: u32, s: Surface, pixel: vec2f, at: vec2f, mask: u32, lift: f32) -> f32 {
    let light = arriving_at(lights[number], s.shadow_origin + frame.caster_from_point);
    let slope = max(dot(s.face_normal, light.towards), 0.05);
    let grazing = sqrt(max(1.0 - slope * slope, 0.0)) / slope;
    let start = s.shadow_origin + frame.caster_from_point + lift * s.face_normal;
    let centre = reaching(number, start, light.towards, light.distance, grazing);
    let ray = ray_through(at);
    let depth = dot(s.shadow_origin - frame.eye, s.face_normal) / dot(ray, s.face_normal);
    var sum = 0.0;
    var count = 0.0;
    var differs = false;
    for (var k = 0u; k < SAMPLES; k++) {
        // The first four of each sixteen are far apart (one pass's pattern); the others follow only at a border.
        if k == 4u && !differs {
            return centre;
        }
        if (mask & (1u << k)) == 0u {
            continue;
        }
        let other = ray_through(pixel + frame.samples[k].xy);
        let moved = dot(s.shadow_origin - frame.eye, s.face_normal) / dot(other, s.face_normal) * other - depth * ray;
        let place = start + select(vec3f(0.0), moved, dot(other, s.face_normal) < 0.0);
        let arriving = arriving_at(lights[number], place);
        let share = reaching(number, place, arriving.towards, arriving.distance, grazing);
        differs = differs || abs(share - centre) > 0.02;
        sum += share;
        count += 1.0;
    }
    return select(sum / count, centre, count == 0.0);
}

fn radiance(s: Surface, pixel: vec2f, at: vec2f, mask: u32) -> vec3f {
    if s.unlit {
        return s.base;
    }
    var rgb = s.emissive;
    if frame.has_panorama == 1u {
        rgb += from_environment(s);
    }
    for (var k = 0u; k < frame.light_count; k++) {
        let light = arriving_at(lights[k], s.shadow_origin + frame.caster_from_point);
        if light.share <= 0.0 || dot(s.normal, light.towards) <= 0.0 {
            continue;
        }
        var share = light.share;
        if lights[k].first_map >= 0 {
            share *= lit_share(k, s, pixel, at, mask, 2.0 * frame.step);
        }
        if share > 0.0 {
            rgb += share * lights[k].rgb * reflected(s, light.towards);
        }
    }
    return rgb;
}

// The samples of a pixel that belong together, and where in the picture they are shaded.
struct Group { id: u32, mask: u32, at: vec2f }

fn next_group(ids: ptr<function, array<u32, 17>>, left: u32, pixel: vec2f) -> Group {
    var group = Group((*ids)[AT_CENTRE], 0u, pixel + 0.5);
    let centre_is_left = group.id != 0u && left == EVERY_SAMPLE;
    if !centre_is_left {
        group.id = (*ids)[firstTrailingBit(left)];
    }
    var sum = vec2f(0.0);
    var own = 0.0;
    var last = 0u;
    var last_is_alike = false;
    for (var k = 0u; k < SAMPLES; k++) {
        let id = (*ids)[k];
        if (left & (1u << k)) == 0u || id == 0u {
            continue;
        }
        if id == group.id {
            sum += frame.samples[k].xy;
            own += 1.0;
            group.mask |= 1u << k;
            continue;
        }
        if id != last {
            last = id;
            last_is_alike = alike(group.id, id, pixel + frame.samples[k].xy);
        }
        group.mask |= select(0u, 1u << k, last_is_alike);
    }
    if !centre_is_left {
        group.at = pixel + sum / max(own, 1.0);
    }
    return group;
}

fn nearest_sample(ids: ptr<function, array<u32, 17>>, pixel: vec2f) -> u32 {
    var nearest = 1e38;
    var result = 0u;
    for (var k = 0u; k < SAMPLES; k++) {
        let id = (*ids)[k];
        if id != 0u {
            let depth = plane_depth(id, ray_through(pixel + frame.samples[k].xy));
            if depth < nearest || result == 0u {
                nearest = depth;
                result = id | (k << 27u);
            }
        }
    }
    return result;
}

fn gathered(place: vec2u, ids: ptr<function, array<u32, 17>>) -> u32 {
    var covered = 0u;
    (*ids)[AT_CENTRE] = textureLoad(seen_centre, place, 0).x;
    for (var k = 0u; k < SAMPLES; k++) {
        let id = seen_by(place, k);
        (*ids)[k] = id;
        covered |= select(0u, 1u << k, id != 0u);
    }
    return covered;
}

@compute @workgroup_size(8, 8)
fn shade(@builtin(global_invocation_id) place: vec3u) {
    if any(place.xy >= frame.size) {
        return;
    }
    let index = place.y * frame.size.x + place.x;
    let pixel = vec2f(place.xy);
    var ids: array<u32, 17>;
    var left = gathered(place.xy, &ids);
    var sum = select(vec4f(0.0), rgba[index], frame.layer > 0u);
    var decides = select(0u, deciding[index], frame.layer > 0u);
    let first_through = index * 17u;
    if frame.layered == 1u && frame.layer == 0u {
        for (var k = 0u; k < 17u; k++) {
            shines_through[first_through + k] = 1.0;
        }
    }
    let centre = ids[AT_CENTRE];
    var centre_alpha = -1.0;
    let any_left = left != 0u;
    while left != 0u {
        let group = next_group(&ids, left, pixel);
        left &= ~group.mask;
        let s = surface_at(group.id, ray_through(group.at), select(0.5, 1.0, group.mask == EVERY_SAMPLE));
        if group.id == centre {
            centre_alpha = s.alpha;
        }
        var share = f32(countOneBits(group.mask)) / 16.0 * s.alpha;
        if frame.layered == 1u {
            share = 0.0;
            for (var k = 0u; k < SAMPLES; k++) {
                if (group.mask & (1u << k)) != 0u {
                    let before = shines_through[first_through + k];
                    share += before * s.alpha / 16.0;
                    shines_through[first_through + k] = before * (1.0 - s.alpha);
                }
            }
        }
        if share > 0.0 {
            sum += vec4f(share * radiance(s, pixel, group.at, group.mask), share);
        }
    }
    // The depth of what one mostly sees: the surface at which half of the view is covered, or else the first.
    let through = select(1.0, shines_through[first_through + AT_CENTRE], frame.layered == 1u);
    if centre != 0u && (through > 0.5 || (decides >> 27u) != AT_CENTRE) {
        decides = centre | (AT_CENTRE << 27u);
    } else if decides == 0u && any_left {
        decides = nearest_sample(&ids, pixel);
    }
    if frame.layered == 1u && centre != 0u {
        if centre_alpha < 0.0 {
            centre_alpha = surface_at(centre, ray_through(pixel + 0.5), 1.0).alpha;
        }
        shines_through[first_through + AT_CENTRE] = through * (1.0 - centre_alpha);
    }
    rgba[index] = select(sum, vec4f(sum.rgb, 1.0), sum.a >= 1.0 - NOTHING_LEFT);
    deciding[index] = decides;
}

// The share of the lights' irradiance that reaches a shadow catcher, 1 where it is not seen.
@compute @workgroup_size(8, 8)
fn shadow_mask(@builtin(global_invocation_id) place: vec3u) {
    if any(place.xy >= frame.size) {
        return;
    }
    let pixel = vec2f(place.xy);
    var ids: array<u32, 17>;
    var left = gathered(place.xy, &ids);
    var lit = 1.0 - f32(countOneBits(left)) / 16.0;
    while left != 0u {
        let group = next_group(&ids, left, pixel);
        left &= ~group.mask;
        let s = surface_at(group.id, ray_through(group.at), 1.0);
        var arriving = 0.0;
        var unobstructed = 0.0;
        for (var k = 0u; k < frame.light_count; k++) {
            let light = arriving_at(lights[k], s.shadow_origin + frame.caster_from_point);
            let amount = max(dot(s.normal, light.towards), 0.0) * light.share * lights[k].luminance;
            unobstructed += amount;
            if amount > 0.0 && lights[k].first_map >= 0 {
                arriving += amount * lit_share(k, s, pixel, group.at, group.mask, 0.0);
            } else {
                arriving += amount;
            }
        }
        lit += f32(countOneBits(group.mask)) / 16.0 * select(arriving / unobstructed, 1.0, unobstructed <= 0.0);
    }
    rgba[place.y * frame.size.x + place.x] = vec4f(lit);
}
