// Shadows: a light's maps say which triangles may lie in the way, and those are then met exactly.
//
// A map holds the number of the triangle nearest to the light instead of its distance. A shadow's border so lies where the
// triangle's does, at any resolution, and no distance has to be fudged for a surface not to shadow itself.
// Only where triangles are smaller than a texel does the map decide alone, and then it is as fine as its texels.

const EDGE_SLACK = 1e-5;

@group(1) @binding(3) var<storage, read> lights: array<Light>;
@group(1) @binding(4) var<storage, read> casters: array<vec4f>;
@group(1) @binding(5) var shadow_maps: texture_2d_array<u32>;

// Distance at which light from a point is met by a triangle, and how much that covers (-1: nowhere on the way).
struct Obstacle { distance: f32, covers: f32 }

fn obstacle(id: u32, origin: vec3f, towards: vec3f, distance: f32) -> Obstacle {
    let first = (id - 1u) * PER_TRIANGLE;
    let hit = meet(casters[first].xyz, casters[first + 1u].xyz, casters[first + 2u].xyz, origin, towards);
    // A ray along the edge that two triangles share must not slip through.
    let is_inside = all(hit.weights >= vec3f(-EDGE_SLACK));
    if !is_inside || hit.depth <= 0.0 || hit.depth >= distance {
        return Obstacle(hit.depth, -1.0);
    }
    if !SEE_THROUGH {
        return Obstacle(hit.depth, 1.0);
    }
    let material = materials[u32(casters[first].w)];
    if material.alpha_mode == OPAQUE {
        return Obstacle(hit.depth, 1.0);
    }
    let uv = mixed4(casters[first + 9u], casters[first + 10u], casters[first + 11u], hit.weights);
    let tint = mixed4(casters[first + 12u], casters[first + 13u], casters[first + 14u], hit.weights);
    return Obstacle(hit.depth, base_color(material, tint, uv, vec2f(0.0)).a);
}

// Which of a lamp's six maps looks towards a point.
fn face_towards(way: vec3f) -> u32 {
    let size = abs(way);
    if size.x >= size.y && size.x >= size.z {
        return select(1u, 0u, way.x > 0.0);
    }
    if size.y >= size.z {
        return select(3u, 2u, way.y > 0.0);
    }
    return select(5u, 4u, way.z > 0.0);
}

// How much of a light's rays reach a point; grazing: tangent of the angle between the surface's normal and the light.
fn reaching(number: u32, origin: vec3f, towards: vec3f, distance: f32, grazing: f32) -> f32 {
    let size = f32(textureDimensions(shadow_maps).x);
    let per_view = 1 + i32(frame.veils);
    var visible = 1.0;
    // Cluster by cluster; layer 0 of each view holds what is solid or cut out, the others what is blended.
    for (var k = 0; k < i32(lights[number].clusters) * per_view && visible > 0.0; k++) {
        let cluster = k / per_view;
        let face = select(0u, face_towards(-towards), lights[number].maps[cluster].faces == 6u);
        let clip = lights[number].maps[cluster].clip_from_point[face] * vec4f(origin, 1.0);
        let is_in_view = clip.w > 0.0 && all(abs(clip.xy) < vec2f(clip.w));
        let at = (vec2f(clip.x, -clip.y) / max(clip.w, 1e-30) * 0.5 + 0.5) * size;
        let layer = lights[number].maps[cluster].first + i32(face) * per_view + k % per_view;
        let width = lights[number].maps[cluster].texel * select(distance, 1.0, lights[number].kind == DIRECTIONAL);
        let margin = 3.0 * width * (1.0 + grazing);
        let low = vec2i(floor(select(vec2f(0.0), at, is_in_view) - 0.5));
        let covers = covered_by(layer, k % per_view == 0, low, origin, towards, distance, margin);
        visible *= select(1.0, 1.0 - covers, is_in_view);
    }
    return visible;
}

// How much of the light one layer of a map keeps from a point: the four texels around say which triangles to meet.
fn covered_by(layer: i32, is_solid: bool, low: vec2i, origin: vec3f, towards: vec3f, distance: f32, margin: f32) -> f32 {
    let last = vec2i(textureDimensions(shadow_maps)) - 1;
    var ids = vec4u(0u);
    for (var k = 0; k < 4; k++) {
        ids[k] = textureLoad(shadow_maps, clamp(low + vec2i(k & 1, k >> 1), vec2i(0), last), layer, 0).x;
    }
    var all_behind = is_solid && all(ids != vec4u(0u));
    var covers = 0.0;
    loop {
        let id = max(max(ids.x, ids.y), max(ids.z, ids.w));
        if id == 0u || covers > 0.0 {
            break;
        }
        ids = select(ids, vec4u(0u), ids == vec4u(id));
        let met = obstacle(id, origin, towards, distance);
        covers = max(met.covers, 0.0);
        // Met beside itself: it may still belong to a surface of triangles smaller than a texel.
        all_behind = all_behind && met.covers < 0.0 && met.distance > margin && met.distance < distance;
    }
    return select(covers, 1.0, all_behind);
}
