// Colour, coverage and the surface that decides the depth of every pixel, from the triangles that its samples see.

fn add_to_list(list: u32, index: u32) {
    let number = atomicAdd(&work[4u * list], 1u);
    atomicStore(&work[LISTED + list * frame.size.x * frame.size.y + number], index);
}

fn lit_of(index: u32) -> u32 { return frame.size.x * frame.size.y + index; }

// First: which pixels see nothing, one smooth surface (plain), or an edge.
@compute @workgroup_size(8, 8)
fn classify(@builtin(global_invocation_id) place: vec3u) {
    if any(place.xy >= frame.size) {
        return;
    }
    let index = place.y * frame.size.x + place.x;
    let pixel = vec2f(place.xy);
    var ids: array<u32, 17>;
    let covered = gathered(place.xy, &ids);
    if frame.layer == 0u {
        rgba[index] = vec4f(0.0);
        pixels[index] = 0u;
        pixels[lit_of(index)] = bitcast<u32>(NOT_PLAIN);
        for (var k = 0u; LAYERED && k < 17u; k++) {
            shines_through[17u * index + k] = 1.0;
        }
    }
    if covered == 0u {
        return;
    }
    let centre = ids[AT_CENTRE];
    let is_plain = covered == EVERY_SAMPLE && centre != 0u && alike_samples(&ids, covered, centre, pixel) == covered;
    let is_untouched = !LAYERED || (frame.is_last == 1u && rgba[index].a == 0.0);
    if is_plain && is_untouched {
        pixels[index] = centre | (AT_CENTRE << 27u);
        add_to_list(0u, index);
    } else {
        add_to_list(1u, index);
    }
}

// Plain pixels whose share of light differs from a neighbour's lie on the border of a shadow and need more samples.
@compute @workgroup_size(8, 8)
fn find_borders(@builtin(global_invocation_id) place: vec3u) {
    if any(place.xy >= frame.size) {
        return;
    }
    let index = place.y * frame.size.x + place.x;
    let here = bitcast<f32>(pixels[lit_of(index)]);
    var differs = false;
    for (var k = 0; k < 9; k++) {
        let there = clamp(vec2i(place.xy) + vec2i(k % 3 - 1, k / 3 - 1), vec2i(0), vec2i(frame.size) - 1);
        let lit = bitcast<f32>(pixels[lit_of(u32(there.y) * frame.size.x + u32(there.x))]);
        differs = differs || (lit != NOT_PLAIN && abs(lit - here) > LIT_STEP);
    }
    if differs && here != NOT_PLAIN {
        rgba[index] = vec4f(0.0);
        add_to_list(1u, index);
    }
}

// How many groups of 64 threads the lists need; both lists' sizes stay beside it.
@compute @workgroup_size(1)
fn size_lists() {
    for (var list = 0u; list < 2u; list++) {
        atomicStore(&work[4u * list + 1u], (atomicLoad(&work[4u * list]) + 63u) / 64u);
        atomicStore(&work[4u * list + 2u], 1u);
        atomicStore(&work[4u * list + 3u], 1u);
    }
}

fn listed(list: u32, number: u32) -> u32 { return atomicLoad(&work[LISTED + list * frame.size.x * frame.size.y + number]); }

fn place_of(index: u32) -> vec2u { return vec2u(index % frame.size.x, index / frame.size.x); }

@compute @workgroup_size(64)
fn shade_plain(@builtin(global_invocation_id) thread: vec3u) {
    if thread.x >= atomicLoad(&work[0]) {
        return;
    }
    let index = listed(0u, thread.x);
    let pixel = vec2f(place_of(index));
    let s = surface_at(pixels[index] & 0x7ffffffu, ray_through(pixel + 0.5), 1.0);
    let shaded = radiance(s, pixel, pixel + 0.5, 0u);
    rgba[index] = vec4f(shaded.rgb, 1.0);
    pixels[lit_of(index)] = bitcast<u32>(shaded.lit);
}

@compute @workgroup_size(64)
fn shade_edges(@builtin(global_invocation_id) thread: vec3u) {
    if thread.x >= atomicLoad(&work[4]) {
        return;
    }
    let index = listed(1u, thread.x);
    let pixel = vec2f(place_of(index));
    var ids: array<u32, 17>;
    let covered = gathered(place_of(index), &ids);
    var left = covered;
    let centre = ids[AT_CENTRE];
    var centre_alpha = 1.0;
    var sum = select(vec4f(0.0), rgba[index], LAYERED);
    let first = index * 17u;
    loop {
        if left == 0u {
            break;
        }
        let group = next_group(&ids, left, pixel);
        left &= ~group.mask;
        let s = surface_at(group.id, ray_through(group.at), select(0.5, 1.0, group.mask == EVERY_SAMPLE));
        var share = f32(countOneBits(group.mask)) / 16.0 * s.alpha;
        if LAYERED {
            let is_at_centre = centre != 0u && corner_of(group.id, 1u).w == corner_of(centre, 1u).w;
            centre_alpha = select(centre_alpha, s.alpha, is_at_centre);
            share = 0.0;
            for (var k = 0u; k < SAMPLES; k++) {
                if (group.mask & (1u << k)) != 0u {
                    let before = shines_through[first + k];
                    share += before * s.alpha / 16.0;
                    shines_through[first + k] = before * (1.0 - s.alpha);
                }
            }
        }
        // On and behind glass four samples have to do for the borders of shadows, as there it is all pixels that come here.
        let looks = select(group.mask, 0x1111u, LAYERED && group.mask == EVERY_SAMPLE);
        sum += vec4f(share * radiance(s, pixel, group.at, looks).rgb, share);
    }
    pixels[index] = decided(&ids, covered, index, centre_alpha);
    rgba[index] = select(sum, vec4f(sum.rgb, 1.0), sum.a >= 1.0 - NOTHING_LEFT);
}

// The depth of what one mostly sees: the surface at which half of the view is covered, or else the first.
// alpha: of the surface at the pixel's centre.
fn decided(ids: ptr<function, array<u32, 17>>, covered: u32, index: u32, alpha: f32) -> u32 {
    let centre = (*ids)[AT_CENTRE];
    let before = select(0u, pixels[index], LAYERED && frame.layer > 0u);
    var through = 1.0;
    if LAYERED {
        through = shines_through[index * 17u + AT_CENTRE];
        if centre != 0u {
            shines_through[index * 17u + AT_CENTRE] = through * (1.0 - alpha);
        }
    }
    if centre != 0u && (through > 0.5 || (before >> 27u) != AT_CENTRE) {
        return centre | (AT_CENTRE << 27u);
    }
    return select(before, nearest_sample(ids, covered, vec2f(place_of(index))), before == 0u);
}

// The share of the lights' irradiance that reaches a shadow catcher.
@compute @workgroup_size(64)
fn mask_plain(@builtin(global_invocation_id) thread: vec3u) {
    if thread.x >= atomicLoad(&work[0]) {
        return;
    }
    let index = listed(0u, thread.x);
    let pixel = vec2f(place_of(index));
    let s = surface_at(pixels[index] & 0x7ffffffu, ray_through(pixel + 0.5), 1.0);
    pixels[lit_of(index)] = bitcast<u32>(catcher_lit_share(s, pixel, pixel + 0.5, 0u));
}

@compute @workgroup_size(64)
fn mask_edges(@builtin(global_invocation_id) thread: vec3u) {
    if thread.x >= atomicLoad(&work[4]) {
        return;
    }
    let index = listed(1u, thread.x);
    let pixel = vec2f(place_of(index));
    var ids: array<u32, 17>;
    var left = gathered(place_of(index), &ids);
    var lit = 1.0 - f32(countOneBits(left)) / 16.0;
    loop {
        if left == 0u {
            break;
        }
        let group = next_group(&ids, left, pixel);
        left &= ~group.mask;
        let s = surface_at(group.id, ray_through(group.at), 1.0);
        lit += f32(countOneBits(group.mask)) / 16.0 * catcher_lit_share(s, pixel, group.at, group.mask);
    }
    pixels[lit_of(index)] = bitcast<u32>(lit);
}
