// The seventeen samples of a pixel: which of them show the same surface, and which is nearest.

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

// The samples of a pixel that belong together, and where in the picture they are shaded.
struct Group { id: u32, mask: u32, at: vec2f }

// Those samples of `left` that show the same smooth surface as a triangle.
fn alike_samples(ids: ptr<function, array<u32, 17>>, left: u32, id: u32, pixel: vec2f) -> u32 {
    var alike_mask = 0u;
    var unknown = left;
    loop {
        if unknown == 0u {
            break;
        }
        let first = firstTrailingBit(unknown);
        let other = (*ids)[first];
        var same = 0u;
        for (var k = 0u; k < SAMPLES; k++) {
            same |= select(0u, 1u << k, (*ids)[k] == other);
        }
        same &= unknown;
        unknown &= ~same;
        let is_alike = other == id || alike(id, other, pixel + frame.samples[first].xy);
        alike_mask |= select(0u, same, is_alike);
    }
    return alike_mask;
}

fn next_group(ids: ptr<function, array<u32, 17>>, left: u32, pixel: vec2f) -> Group {
    let centre = (*ids)[AT_CENTRE];
    var sum_centre = 0.0;
    for (var k = 0u; k < SAMPLES; k++) {
        sum_centre += select(0.0, 1.0, (*ids)[k] == centre);
    }
    let from_centre = left == EVERY_SAMPLE && sum_centre > 0.0;
    let id = select((*ids)[firstTrailingBit(left)], centre, from_centre);
    var sum = vec3f(0.0);
    for (var k = 0u; k < SAMPLES; k++) {
        let is_own = (*ids)[k] == id && (left & (1u << k)) != 0u;
        sum += select(vec3f(0.0), vec3f(frame.samples[k].xy, 1.0), is_own);
    }
    let place = select(sum.xy / max(sum.z, 1.0), vec2f(0.5), from_centre);
    return Group(id, alike_samples(ids, left, id, pixel), pixel + place);
}

fn nearest_sample(ids: ptr<function, array<u32, 17>>, covered: u32, pixel: vec2f) -> u32 {
    var nearest = 1e38;
    var result = 0u;
    var left = covered;
    loop {
        if left == 0u {
            break;
        }
        let k = firstTrailingBit(left);
        left &= left - 1u;
        let depth = plane_depth((*ids)[k], ray_through(pixel + frame.samples[k].xy));
        result = select(result, (*ids)[k] | (k << 27u), depth < nearest || result == 0u);
        nearest = min(nearest, depth);
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
