// Shading points and the light that leaves them. Mirrors _surface_numba.py and PreparedScene.

fn corner_of(id: u32, number: u32) -> vec4f { return triangles[(id - 1u) * PER_TRIANGLE + number]; }

fn face_of(id: u32) -> vec3f {
    let a = corner_of(id, 0u).xyz;
    return unit(cross(corner_of(id, 1u).xyz - a, corner_of(id, 2u).xyz - a));
}

fn plane_depth(id: u32, ray: vec3f) -> f32 {
    let face = face_of(id);
    return dot(face, corner_of(id, 0u).xyz - frame.eye) / dot(face, ray);
}

fn mapped_normal(read: vec3f, normal_scale: f32, first: u32, smooth_normal: vec3f, facing: f32, w: vec3f) -> vec3f {
    var along = mixed3(triangles[first + 6u].xyz, triangles[first + 7u].xyz, triangles[first + 8u].xyz, w);
    along -= dot(smooth_normal, along) * smooth_normal;
    if dot(along, along) < 1e-20 {
        return smooth_normal;
    }
    // `smooth_normal` is already on the viewer's side, while the tangent frame belongs to the front.
    let tilt = normal_scale * facing;
    along = unit(along);
    let across = cross(smooth_normal, along) * triangles[first + 6u].w * facing;
    let lean = 2.0 * read - 1.0;
    return unit(mixed3(along, across, smooth_normal, vec3f(lean.x * tilt, lean.y * tilt, lean.z)));
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
    var base = material.base_color;
    if !CATCHER {
        base = base_color(material, tint, uv, footprint);
    }
    // What a mask cuts out was already left out when the samples were taken.
    s.alpha = select(base.a, 1.0, material.alpha_mode == MASK);
    s.base = base.rgb;
    let n0 = triangles[first + 3u].xyz;
    let n1 = triangles[first + 4u].xyz;
    let n2 = triangles[first + 5u].xyz;
    let smooth_normal = unit(mixed3(n0, n1, n2, w)) * facing;
    s.normal = smooth_normal;
    // Shadow rays start on the smooth surface that the triangles stand for (Hanika 2021, "Hacking the Shadow Terminator").
    let point = mixed3(a, b, c, w);
    let below = min(vec3f(0.0), facing * vec3f(dot(point - a, n0), dot(point - b, n1), dot(point - c, n2)));
    s.shadow_origin = point - facing * mixed3(n0, n1, n2, w * below);
    var metallic = material.metallic;
    s.roughness = material.roughness;
    s.emissive = material.emissive;
    s.occlusion = 1.0;
    if TEXTURED && !CATCHER {
        var read: array<vec4f, 4>;
        for (var k = 0u; k < 4u; k++) {
            if material.textures[k] >= 0 {
                read[k] = read_texture(material.textures[k], uv, footprint);
            }
        }
        let is_there = material.textures >= vec4i(0);
        metallic *= select(1.0, read[0].b, is_there.x);
        s.roughness *= select(1.0, read[0].g, is_there.x);
        s.emissive *= select(vec3f(1.0), read[1].rgb, is_there.y);
        let mapped = mapped_normal(read[2].xyz, material.normal_scale, first, smooth_normal, facing, w);
        s.normal = select(smooth_normal, mapped, is_there.z);
        s.occlusion += select(0.0, material.occlusion_strength * (read[3].r - 1.0), is_there.w);
    }
    s.roughness = clamp(s.roughness, 0.0, 1.0);
    s.diffuse = s.base * (1.0 - metallic);
    s.f0 = material.f0 * (1.0 - metallic) + s.base * metallic;
    s.f90 = material.f90 + metallic * (1.0 - material.f90);
    s.unlit = material.unlit == 1u;
    return s;
}

// Mean visibility of a light over the samples of a mask; an empty mask asks for the shading point only.
fn lit_share(number: u32, s: Surface, pixel: vec2f, at: vec2f, mask: u32, lift: f32) -> f32 {
    let start = s.shadow_origin + frame.caster_from_point + lift * s.face_normal;
    let light = arriving_at(lights[number], start);
    let slope = max(dot(s.face_normal, light.towards), 0.05);
    let grazing = sqrt(max(1.0 - slope * slope, 0.0)) / slope;
    let height = dot(s.shadow_origin - frame.eye, s.face_normal);
    let ray = ray_through(at);
    let middle = height / dot(ray, s.face_normal) * ray;
    var sum = 0.0;
    var left = mask;
    loop {
        var place = start;
        if left != 0u {
            let other = ray_through(pixel + frame.samples[firstTrailingBit(left)].xy);
            let facing = dot(other, s.face_normal);
            place += select(vec3f(0.0), height / facing * other - middle, facing < 0.0);
        }
        let arriving = arriving_at(lights[number], place);
        sum += reaching(number, place, arriving.towards, arriving.distance, grazing);
        left &= left - select(0u, 1u, left != 0u);
        if left == 0u {
            break;
        }
    }
    return sum / f32(max(countOneBits(mask), 1u));
}

// Light from a surface towards the camera, and the mean share of the lights that is not in shadow.
struct Shaded { rgb: vec3f, lit: f32 }

fn radiance(s: Surface, pixel: vec2f, at: vec2f, mask: u32) -> Shaded {
    var rgb = s.emissive;
    var lit = 1.0;
    if LIT_BY_PANORAMA {
        rgb += from_environment(s);
    }
    for (var k = 0u; LIT_BY_LIGHTS && k < frame.light_count; k++) {
        let light = arriving_at(lights[k], s.shadow_origin + frame.caster_from_point);
        let facing = light.share > 0.0 && dot(s.normal, light.towards) > 0.0;
        var reaches = 1.0;
        if lights[k].clusters > 0u && facing {
            reaches = lit_share(k, s, pixel, at, mask, 2.0 * frame.step);
            lit -= (1.0 - reaches) / f32(frame.light_count);
        }
        if facing {
            rgb += reaches * light.share * lights[k].rgb * reflected(s, light.towards);
        }
    }
    return Shaded(select(rgb, s.base, s.unlit), lit);
}

fn catcher_lit_share(s: Surface, pixel: vec2f, at: vec2f, mask: u32) -> f32 {
    var arriving = 0.0;
    var unobstructed = 0.0;
    for (var k = 0u; k < frame.light_count; k++) {
        let light = arriving_at(lights[k], s.shadow_origin + frame.caster_from_point);
        let amount = max(dot(s.normal, light.towards), 0.0) * light.share * lights[k].luminance;
        unobstructed += amount;
        var reaches = 1.0;
        if amount > 0.0 && lights[k].clusters > 0u {
            reaches = lit_share(k, s, pixel, at, mask, 0.0);
        }
        arriving += amount * reaches;
    }
    return select(arriving / unobstructed, 1.0, unobstructed <= 0.0);
}
