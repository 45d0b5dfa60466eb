// Which triangle each sample of a picture sees (its number + 1), from a camera or from a light.

struct View {
    clip_from_point: mat4x4f,
    eye: vec4f,        // xyz the eye (w = 1) or the way the light travels (w = 0); the axis of depth below
    axis: vec4f,       // w: width of a pixel at unit depth, for reading textures
    one_sided: u32,    // 1: single-sided surfaces vanish from behind (cameras), 0: they do not (shadows)
    peels: u32,        // 1: only what lies behind the layer before counts
}

@group(1) @binding(0) var<uniform> view: View;
@group(2) @binding(0) var layer_before: texture_depth_2d;
@group(2) @binding(1) var layer_before_4: texture_depth_multisampled_2d;

struct Corner {
    @builtin(position) @invariant position: vec4f,
    @location(0) @interpolate(flat, first) triangle: u32,
}

@vertex
fn corner(@builtin(vertex_index) index: u32) -> Corner {
    let triangle = index / 3u;
    let first = triangle * PER_TRIANGLE;
    let a = triangles[first];
    if view.one_sided == 1u && materials[u32(a.w)].double_sided == 0u {
        let face = cross(triangles[first + 1u].xyz - a.xyz, triangles[first + 2u].xyz - a.xyz);
        if dot(face, a.xyz - view.eye.xyz) >= 0.0 {
            return Corner(vec4f(2.0, 2.0, 2.0, 1.0), triangle);
        }
    }
    return Corner(view.clip_from_point * vec4f(triangles[first + index % 3u].xyz, 1.0), triangle);
}

fn number(triangle: u32) -> vec4u { return vec4u(triangle + 1u, 0u, 0u, 0u); }

// Multisampled targets hold 16 bits per channel at most.
fn number_halves(triangle: u32) -> vec4u { return vec4u((triangle + 1u) & 0xffffu, (triangle + 1u) >> 16u, 0u, 0u); }

@fragment
fn solid(in: Corner) -> @location(0) vec4u { return number(in.triangle); }

@fragment
fn solid_4(in: Corner) -> @location(0) vec4u { return number_halves(in.triangle); }

@group(1) @binding(1) var<uniform> rays: array<vec4f, 4>;

// How much the surface covers where the sample's ray meets it.
fn coverage(triangle: u32, position: vec2f) -> f32 {
    let first = triangle * PER_TRIANGLE;
    let way = rays[0].xyz + position.x * rays[1].xyz + position.y * rays[2].xyz;
    // Of a camera the ray's direction moves with the pixel, of the sun its origin.
    let origin = select(way, view.eye.xyz, view.eye.w == 1.0);
    let ray = select(view.eye.xyz, way, view.eye.w == 1.0);
    let hit = meet(triangles[first].xyz, triangles[first + 1u].xyz, triangles[first + 2u].xyz, origin, ray);
    let w = clamped(hit.weights);
    let uv = mixed4(triangles[first + 9u], triangles[first + 10u], triangles[first + 11u], w);
    let tint = mixed4(triangles[first + 12u], triangles[first + 13u], triangles[first + 14u], w);
    let width = view.axis.w * select(1.0, hit.depth, view.eye.w == 1.0);
    let footprint = width * vec2f(triangles[first + 3u].w, triangles[first + 4u].w);
    return base_color(materials[u32(triangles[first].w)], tint, uv, footprint).a;
}

@fragment
fn see_through(in: Corner) -> @location(0) vec4u {
    if view.peels == 1u && in.position.z >= textureLoad(layer_before, vec2u(in.position.xy), 0) {
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
    if coverage(in.triangle, in.position.xy) == 0.0 {
        discard;
    }
    return number_halves(in.triangle);
}
