// Which triangle each sample of a picture sees (its number + 1), from a camera or from a light.

struct View {
    clip_from_point: mat4x4f,
    eye: vec4f,        // xyz the eye (w = 1) or the way the light travels (w = 0)
    way: vec4f,        // of a camera the ray through (0, 0) of the picture, of a sun the ray's origin; w: width of a pixel
    way_right: vec4f,  // how that changes per pixel
    way_down: vec4f,
    one_sided: u32,    // 1: single-sided surfaces vanish from behind (cameras), 0: they do not (shadows)
    peels: u32,        // 1: only what lies behind the layer before counts
    is_hidden: u32,    // 1: what lies behind solid surfaces does not count
}

@group(1) @binding(0) var<uniform> view: View;
@group(2) @binding(0) var layer_before: texture_depth_2d;
@group(2) @binding(1) var layer_before_4: texture_depth_multisampled_2d;
@group(2) @binding(2) var solid_depth: texture_depth_2d;
@group(2) @binding(3) var solid_depth_4: texture_depth_multisampled_2d;

struct Corner {
    @builtin(position) @invariant position: vec4f,
    @location(0) @interpolate(flat, first) triangle: u32,
}

@vertex
fn corner(@builtin(vertex_index) index: u32) -> Corner {
    let triangle = index / 3u;
    let first = triangle * PER_TRIANGLE;
    let a = triangles[first];
    let b = triangles[first + 1u].xyz;
    let c = triangles[first + 2u].xyz;
    let own = select(select(c, b, index % 3u == 1u), a.xyz, index % 3u == 0u);
    let is_back = dot(cross(b - a.xyz, c - a.xyz), a.xyz - view.eye.xyz) >= 0.0;
    if view.one_sided == 1u && is_back && materials[u32(a.w)].double_sided == 0u {
        return Corner(vec4f(2.0, 2.0, 2.0, 1.0), triangle);
    }
    return Corner(view.clip_from_point * vec4f(own, 1.0), triangle);
}

fn number(triangle: u32) -> vec4u { return vec4u(triangle + 1u, 0u, 0u, 0u); }

// Multisampled targets hold 16 bits per channel at most.
fn number_halves(triangle: u32) -> vec4u { return vec4u((triangle + 1u) & 0xffffu, (triangle + 1u) >> 16u, 0u, 0u); }

@fragment
fn solid(in: Corner) -> @location(0) vec4u { return number(in.triangle); }

@fragment
fn solid_4(in: Corner) -> @location(0) vec4u { return number_halves(in.triangle); }

// How much the surface covers where the sample's ray meets it.
fn coverage(triangle: u32, position: vec2f) -> f32 {
    let first = triangle * PER_TRIANGLE;
    let way = view.way.xyz + position.x * view.way_right.xyz + position.y * view.way_down.xyz;
    // Of a camera the ray's direction moves with the pixel, of the sun its origin.
    let origin = select(way, view.eye.xyz, view.eye.w == 1.0);
    let ray = select(view.eye.xyz, way, view.eye.w == 1.0);
    let hit = meet(triangles[first].xyz, triangles[first + 1u].xyz, triangles[first + 2u].xyz, origin, ray);
    let w = clamped(hit.weights);
    let uv = mixed4(triangles[first + 9u], triangles[first + 10u], triangles[first + 11u], w);
    let tint = mixed4(triangles[first + 12u], triangles[first + 13u], triangles[first + 14u], w);
    let width = view.way.w * select(1.0, hit.depth, view.eye.w == 1.0);
    let footprint = width * vec2f(triangles[first + 3u].w, triangles[first + 4u].w);
    return base_color(materials[u32(triangles[first].w)], tint, uv, footprint).a;
}

@fragment
fn see_through(in: Corner) -> @location(0) vec4u {
    if view.peels == 1u && in.position.z >= textureLoad(layer_before, vec2u(in.position.xy), 0) {
        discard;
    }
    if view.is_hidden == 1u && in.position.z < textureLoad(solid_depth, vec2u(in.position.xy), 0) {
        discard;
    }
    if coverage(in.triangle, in.position.xy) == 0.0 {
        discard;
    }
    return number(in.triangle);
}

@fragment
fn see_through_4(in: Corner, @builtin(sample_index) index: u32) -> @location(0) vec4u {
    if view.peels == 1u && in.position.z >= textureLoad(layer_before_4, vec2u(in.position.xy), i32(index)) {
        discard;
    }
    if view.is_hidden == 1u && in.position.z < textureLoad(solid_depth_4, vec2u(in.position.xy), i32(index)) {
        discard;
    }
    if coverage(in.triangle, in.position.xy) == 0.0 {
        discard;
    }
    return number_halves(in.triangle);
}
