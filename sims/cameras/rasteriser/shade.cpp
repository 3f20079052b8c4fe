// What each pixel shows: runs of pixels of one triangle are shaded together.
#include <algorithm>

#include "lighting.hpp"
#include "scan.hpp"

namespace raster {

// Light on a geom's vertices; that of before, if nothing has moved.
void Scene::light(Placed& placed, int index) {
    const Mesh& mesh = *meshes[placed.geom.mesh];
    const Geom& geom = placed.geom;
    Slot& slot = slots_[index];
    bool shines = false;
    for (const Light& each : lights_)
        shines |= geom.specular > 0 && (each.specular[0] + each.specular[1] + each.specular[2]) > 0;
    const int sides = geom.culled ? 1 : 2;
    if (!shines && slot.light.size() == sides * mesh.points.size() &&
        !std::memcmp(&slot.geom, &geom, sizeof geom)) {
        placed.light = slot.light.data();
        return;
    }
    const Vec3 eye{view_.position[0], view_.position[1], view_.position[2]};
    const Vec3 origin{geom.position[0], geom.position[1], geom.position[2]};
    slot.light.clear();
    for (int side = 0; side < sides; ++side)
        for (std::size_t k = 0; k < mesh.points.size(); ++k) {
            const Vec3f p = mesh.points[k], n = mesh.normals[k];
            const Vec3 normal = unit(geom.turn * Vec3{n.x, n.y, n.z}) * (side ? -1.0 : 1.0);
            const Vec3 point = geom.turn * Vec3{p.x, p.y, p.z} + origin;
            slot.light.push_back(lit(geom, lights_, point, normal, eye));
        }
    slot.geom = geom;
    placed.light = slot.light.data();
}

// Planes of all that is interpolated on a triangle, computed when its first pixel is shaded.
const Surface& Scene::surface(std::int32_t number) {
    if (surface_of_[number] >= 0) return surfaces_[surface_of_[number]];
    surface_of_[number] = static_cast<std::int32_t>(surfaces_.size());
    const Triangle& triangle = triangles_[number];
    Placed& placed = placed_[triangle.geom];
    if (!placed.light) light(placed, triangle.geom);
    const Mesh& mesh = *meshes[placed.geom.mesh];
    const std::int32_t* corners = mesh.corners.data() + triangle.corner;
    const Vec3 points[3] = {placed.seen[corners[0]], placed.seen[corners[1]],
                            placed.seen[corners[2]]};
    const double share =
        1.0 / dot(cross(points[1] - points[0], points[2] - points[0]), points[0]);
    Vec3 weights[3];  // of the corners, times the ray and its length
    for (int k = 0; k < 3; ++k)
        weights[k] = cross(points[(k + 1) % 3], points[(k + 2) % 3]) * share;
    const auto plane = [&](float (&to)[3], float a, float b, float c) {
        const Vec3 sum = weights[0] * double(a) + weights[1] * double(b) + weights[2] * double(c);
        to[0] = static_cast<float>(sum.x);
        to[1] = static_cast<float>(sum.y);
        to[2] = static_cast<float>(sum.z);
    };
    Surface made{};
    made.texture = nullptr;
    if (placed.geom.texture >= 0) {
        made.texture = textures[placed.geom.texture].get();
        made.width = static_cast<float>(made.texture->level(0).width);
        made.height = static_cast<float>(made.texture->level(0).height);
        const float* at = mesh.places.data();
        const auto place = [&](int k, int axis) {
            return at[2 * corners[k] + axis] * placed.geom.repeat[axis] + placed.geom.offset;
        };
        if (made.texture->is_cube) {
            const float(&scale)[3] = placed.geom.cube;
            const Vec3f a = mesh.points[corners[0]], b = mesh.points[corners[1]];
            const Vec3f c = mesh.points[corners[2]];
            plane(made.u, a.x * scale[0], b.x * scale[0], c.x * scale[0]);
            plane(made.v, a.y * scale[1], b.y * scale[1], c.y * scale[1]);
            plane(made.w, a.z * scale[2], b.z * scale[2], c.z * scale[2]);
        } else {
            plane(made.u, place(0, 0), place(1, 0), place(2, 0));
            plane(made.v, place(0, 1), place(1, 1), place(2, 1));
        }
    }
    const Vec3f* light = placed.light + (share > 0 ? mesh.points.size() : 0);
    const Vec3f l[3] = {light[corners[0]], light[corners[1]], light[corners[2]]};
    made.flat = !std::memcmp(&l[0], &l[1], sizeof l[0]) && !std::memcmp(&l[0], &l[2], sizeof l[0]);
    made.same[0] = l[0].x, made.same[1] = l[0].y, made.same[2] = l[0].z;
    if (!made.flat) {
        plane(made.light[0], l[0].x, l[1].x, l[2].x);
        plane(made.light[1], l[0].y, l[1].y, l[2].y);
        plane(made.light[2], l[0].z, l[1].z, l[2].z);
    }
    made.opacity = placed.geom.rgba[3];
    surfaces_.push_back(made);
    return surfaces_.back();
}

// Rays of a step to the right and of one down, beside a pixel's.
inline void Scene::steps(int x, int y, Vec3f& right, Vec3f& below) const {
    if (lens_->pinhole) {
        right = {lens_->pitch[0], 0, 0};
        below = {0, lens_->pitch[1], 0};
    } else {
        const Vec3f here = ray(x, y);
        right = ray(std::min(x + 1, lens_->width - 1), y) - here;
        below = ray(x, std::min(y + 1, lens_->height - 1)) - here;
    }
}

// Level of a mipmap, in 256ths, whose texels are as large as a pixel that covers so many of the
// finest, squared.
inline int level_of(float most, const Texture& texture) {
    if (!(most > 1.0f)) return 0;  // also where a ray's neighbour is none
    const int detail = static_cast<int>(128.0f * log_2(most));
    return std::min(detail, (texture.levels() - 1) << 8);
}

inline int Scene::detail_of(const Surface& surface, const Triangle& triangle, int x, int y,
                            float inverse, float u, float v) const {
    const float width = inverse * surface.width, height = inverse * surface.height;
    Vec3f right, below;
    steps(x, y, right, below);
    const auto step = [&](Vec3f along) {
        const float dq = times(triangle.depth, along);
        const float across = (times(surface.u, along) - u * dq) * width;
        const float down = (times(surface.v, along) - v * dq) * height;
        return across * across + down * down;
    };
    return level_of(std::max(step(right), step(below)), *surface.texture);
}

inline int Scene::detail_around(const Surface& surface, const Triangle& triangle, int x, int y,
                                float inverse, Vec3f at) const {
    const auto size = [](float value) { return value < 0 ? -value : value; };
    const float most = std::max({size(at.x), size(at.y), size(at.z), 1e-20f});
    const float scale = inverse * 0.5f * surface.width / most;
    Vec3f right, below;
    steps(x, y, right, below);
    const auto step = [&](Vec3f along) {
        const float dq = times(triangle.depth, along);
        const Vec3f moved = (Vec3f{times(surface.u, along), times(surface.v, along),
                                   times(surface.w, along)} - at * dq) * scale;
        return dot(moved, moved);
    };
    return level_of(std::max(step(right), step(below)), *surface.texture);
}

// Colours (0 to 255) of `count` pixels of a triangle in a row, from x on; `q`: their inverse depth.
inline void Scene::colours(const Surface& surface, const Triangle& triangle, int x, int y, f8 q,
                           int count, f4* found) const {
    const f8 inverse = 1.0f / q;
    f8 rx, ry = f8{} + (lens_->pinhole ? lens_->y[y] : 0.0f), rz = f8{} + 1.0f;
    if (lens_->pinhole) {
        rx = load(&lens_->x[x]);
    } else {
        const std::size_t at = std::size_t(y) * lens_->stride + x;
        rx = load(&lens_->x[at]), ry = load(&lens_->y[at]), rz = load(&lens_->z[at]);
    }
    const auto times = [&](const float(&plane)[3]) {
        return (rx * plane[0] + (ry * plane[1] + rz * plane[2])) * inverse;
    };
    const int middle = count / 2;
    if (surface.texture && surface.texture->is_cube) {
        const f8 u = times(surface.u), v = times(surface.v), w = times(surface.w);
        const int detail = detail_around(surface, triangle, x + middle, y, inverse[middle],
                                         {u[middle], v[middle], w[middle]});
        for (int k = 0; k < count; ++k)
            found[k] = surface.texture->around({u[k], v[k], w[k]}, detail);
    } else if (surface.texture) {
        const f8 u = times(surface.u), v = times(surface.v);
        const int detail =
            detail_of(surface, triangle, x + middle, y, inverse[middle], u[middle], v[middle]);
        surface.texture->sample(u, v, count, detail, found);
    } else {
        for (int k = 0; k < count; ++k) found[k] = f4{} + 65280.0f;
    }
    if (surface.flat) {
        const f4 light = f4{surface.same[0], surface.same[1], surface.same[2], 0} * (1.0f / 256);
        for (int k = 0; k < count; ++k) found[k] *= light;
    } else {
        const f8 r = times(surface.light[0]) * (1.0f / 256);
        const f8 g = times(surface.light[1]) * (1.0f / 256);
        const f8 b = times(surface.light[2]) * (1.0f / 256);
        for (int k = 0; k < count; ++k) found[k] *= f4{r[k], g[k], b[k], 0};
    }
    if (view_.fogged) {
        const f8 clear = (view_.fog_end - inverse * rz) / (view_.fog_end - view_.fog_start);
        const f4 fog{view_.fog[0], view_.fog[1], view_.fog[2], 0};
        for (int k = 0; k < count; ++k) {
            const float share = std::min(std::max(clear[k], 0.0f), 1.0f);
            found[k] = found[k] * share + fog * (255.0f * (1.0f - share));
        }
    }
}

// Write a pixel and, where there is room, a byte after it, which the next pixel will overwrite.
inline void write(std::uint8_t* to, f4 colour, const std::uint8_t* end) {
    colour = colour > 255.0f ? f4{} + 255.0f : colour;
    colour = colour < 0.0f ? f4{} : colour;
    using u8x4 = std::uint8_t __attribute__((vector_size(4)));
    const u8x4 levels =
        __builtin_convertvector(__builtin_convertvector(colour + 0.5f, i4), u8x4);
    std::memcpy(to, &levels, to + 4 <= end ? 4 : 3);
}

void Scene::shade(std::uint8_t* rgb) {
    end_ = rgb + std::size_t(view_.last - view_.first) * lens_->width * 3;
    for (int y = view_.first; y < view_.last; ++y) {
        const std::size_t at = std::size_t(y - view_.first) * lens_->stride;
        std::uint8_t* row = rgb + std::size_t(y - view_.first) * lens_->width * 3;
        for (int left = 0, right; left < lens_->width; left = right) {
            const std::int32_t number = visible_[at + left];
            for (right = left + 1; right < lens_->width && visible_[at + right] == number;) ++right;
            if (number < 0)
                shade_sky(row, y, left, right);
            else
                shade_run(row, y, left, right, number);
        }
    }
}

void Scene::shade_run(std::uint8_t* row, int y, int left, int right, std::int32_t number) {
    const Surface& surface = this->surface(number);
    const Triangle& triangle = triangles_[number];
    const float* nearest = nearest_.data() + std::size_t(y - view_.first) * lens_->stride;
    f4 found[lanes];
    for (; left < right; left += lanes) {
        const int count = std::min(right - left, lanes);
        colours(surface, triangle, left, y, load(nearest + left), count, found);
        for (int k = 0; k < count; ++k) write(row + 3 * (left + k), found[k], end_);
    }
}

void Scene::shade_sky(std::uint8_t* row, int y, int left, int right) {
    for (int x = left; x < right; ++x) {
        f4 found{};
        const Vec3f along = ray(x, y);
        if (view_.sky >= 0 && along.x * along.x + along.y * along.y + along.z * along.z > 0) {
            const Vec3 world = view_.turn * Vec3{along.x, along.y, along.z};
            found = textures[view_.sky]->around({static_cast<float>(world.x),
                                                 static_cast<float>(world.z),
                                                 static_cast<float>(-world.y)}, 0) *
                    (1.0f / 256);
        }
        write(row + 3 * x, found, end_);
    }
}

// Whether a pixel on an edge is the triangle's, and not that of the one beyond.
bool Scene::owns(const Triangle& triangle, Vec3f ray) {
    for (const auto& edge : triangle.edges)
        if (times(edge, ray) == 0.0f && !(edge[0] > 0 || (edge[0] == 0 && edge[1] > 0)))
            return false;
    return true;
}

// Draw what is see-through over what is behind it, from the back to the front. It has a number, but
// no depth.
void Scene::blend(std::uint8_t* rgb) {
    if (!blended_.empty()) front_ = nearest_;
    for (const std::int32_t number : blended_) {
        const auto found = [&](int y, int x, i8 inside, f8 q) {
            const std::size_t at = std::size_t(y - view_.first) * lens_->stride + x;
            const i8 wins = inside & (q > load(&nearest_[at]));
            for (int k = 0; k < lanes && x + k < lens_->width; ++k) {
                if (!wins[k] || !owns(triangles_[number], ray(x + k, y))) continue;
                if (q[k] > front_[at + k]) front_[at + k] = q[k], visible_[at + k] = number;
                if (!rgb) continue;
                const Surface& surface = this->surface(number);
                f4 mine;
                colours(surface, triangles_[number], x + k, y, f8{} + q[k], 1, &mine);
                std::uint8_t* to =
                    rgb + (std::size_t(y - view_.first) * lens_->width + x + k) * 3;
                const f4 behind{float(to[0]), float(to[1]), float(to[2]), 0};
                write(to, behind + (mine - behind) * surface.opacity, to + 3);
            }
        };
        over(triangles_[number], found);
    }
}

}  // namespace raster
