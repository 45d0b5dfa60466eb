// Shadows: a light's maps say which triangles may lie in the way, and those are then met exactly.
//
// A map holds the number of the triangle nearest to the light instead of its distance. A shadow's border so lies where the
// triangle's does, at any resolution, and no distance has to be fudged for a surface not to shadow itself.
// Only where triangles are smaller than a texel does the map decide alone, and then it is as fine as its texels.

@group(1) @binding(3) var<storage, read> lights: array<Light>;
@group(1) @binding(4) var<storage, read> casters: array<vec4f>;
@group(1) @binding(5) var shadow_maps: texture_2d_array<u32>;

// Distance at which light from a point is met by a triangle, and how much that covers (-1: nowhere on the way).
struct Obstacle { distance: f32, covers: f32 }

fn obstacle(id: u32, origin: vec3f, towards: vec3f, distance: f32) -> Obstacle {
    let first = (id - 1u) * PER_TRIANGLE;
    let hit = meet(casters[first].xyz, casters[first + 1u].xyz, casters[first + 2u].xyz, origin, towards);
    if !hit.inside || hit.depth <= 0.0 || hit.depth >= distance {
        return Obstacle(hit.depth, -1.0);
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
    var face = 0u;
    if lights[number].faces == 6u {
        face = face_towards(-towards);
    }
    let clip = lights[number].clip_from_point[face] * vec4f(origin, 1.0);
    if clip.w <= 0.0 || any(abs(clip.xy) >= vec2f(clip.w)) {
        return 1.0;
    }
    let size = f32(textureDimensions(shadow_maps).x);
    let at = (vec2f(clip.x, -clip.y) / clip.w * 0.5 + 0.5) * size;
    let low = vec2i(floor(at - 0.5));
    let layer = lights[number].first_map + i32(face * (1u + frame.veils));
    let margin = 3.0 * lights[number].texel * select(distance, 1.0, lights[number].kind == DIRECTIONAL) * (1.0 + grazing);
    var all_behind = true;
    var last = 0u;
    for (var k = 0; k < 4; k++) {
        let place = clamp(low + vec2i(k & 1, k >> 1), vec2i(0), vec2i(i32(size) - 1));
        let id = textureLoad(shadow_maps, place, layer, 0).x;
        if id == 0u {
            all_behind = false;
        } else if id != last {
            let met = obstacle(id, origin, towards, distance);
            if met.covers > 0.0 {
                return 0.0;
            }
            // Met beside itself: it may still belong to a surface of triangles smaller than a texel.
            all_behind = all_behind && met.covers < 0.0 && met.distance > margin && met.distance < distance;
            last = id;
        }
    }
    if all_behind {
        return 0.0;
    }
    var visible = 1.0;
    for (var k = 1; k <= i32(frame.veils); k++) {
        let id = textureLoad(shadow_maps, clamp(vec2i(floor(at)), vec2i(0), vec2i(i32(size) - 1)), layer + k, 0).x;
        if id == 0u {
            break;
        }
        visible *= 1.0 - max(obstacle(id, origin, towards, distance).covers, 0.0);
    }
    return visible;
}
