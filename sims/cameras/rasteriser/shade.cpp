// What each pixel shows: runs of pixels of one triangle are shaded together.
#include <algorithm>

#include "band.hpp"
#include "lighting.hpp"

namespace raster {

constexpr float rounding = 2e-6f;  // of a depth by the inverse depth of the plane that it is on

// Light on a geom's vertices; that of before, if nothing has moved.
void Scene::light(const Geom& geom, const Pose& pose, Slot& slot) const {
    if (slot.frame == frame_ && !slot.light.empty()) return;
    slot.frame = frame_;
    const Mesh& mesh = *meshes[geom.mesh];
    bool shines = false;
    for (const Light& each : lights_)
        shines |= geom.specular > 0 && (each.specular[0] + each.specular[1] + each.specular[2]) > 0;
    const std::size_t count = mesh.points.size();
    if (!shines && slot.light.size() == count * (1 + casters_.size()) &&
        !std::memcmp(&slot.geom, &geom, sizeof geom) &&
        !std::memcmp(&slot.pose, &pose, sizeof pose))
        return;
    const Vec3 eye{middle_eye_.position[0], middle_eye_.position[1], middle_eye_.position[2]};
    const Vec3 origin{pose.position[0], pose.position[1], pose.position[2]};
    slot.light.resize(count * (1 + casters_.size()));
    for (std::size_t k = 0; k < count; ++k) {
        const Vec3f p = mesh.points[k], n = mesh.normals[k];
        const Vec3 normal = unit(pose.turn * Vec3{n.x, n.y, n.z});
        const Vec3 point = pose.turn * Vec3{p.x, p.y, p.z} + origin;
        lit(geom, lights_, point, normal, eye, &slot.light[k], count);
    }
    slot.geom = geom, slot.pose = pose;
}

// Planes of all that is interpolated on a triangle, computed when its first pixel is shaded; while
// it moves, those of a row.
const Surface& Band::surface(std::int32_t number, int y) {
    const bool rolling = view_.poses > 1;
    if (!rolling) {
        std::int32_t& known = surface_of(number);
        if (known >= 0) return surfaces_[known];
        known = static_cast<std::int32_t>(surfaces_.size());
    } else {
        surfaces_.clear(), shades_.clear();
    }
    const Triangle& triangle = this->triangle(number);
    const Placed& placed = scene_.placed_[triangle.geom];
    const Geom& geom = *placed.geom;
    const Mesh& mesh = *placed.mesh;
    const std::int32_t* corners = mesh.corners.data() + triangle.corner;
    const Corners seen =
        rolling ? between_poses(number, y)
                : Corners({placed.seen[corners[0]], placed.seen[corners[1]], placed.seen[corners[2]]});
    const double share = 1.0 / seen.away;
    const Vec3 weights[3] = {seen.edges[1] * share, seen.edges[2] * share, seen.edges[0] * share};
    const auto plane = [&](float (&to)[3], float a, float b, float c) {
        put(to, weights[0] * double(a) + weights[1] * double(b) + weights[2] * double(c));
    };
    Surface made{};
    put(made.depth, weights[0] + weights[1] + weights[2]);
    made.opacity = 1.0f - (1.0f - geom.rgba[3]) * (1.0f - geom.rgba[3]);  // MuJoCo draws it twice
    if (geom.texture >= 0) {
        made.texture = scene_.textures[geom.texture].get();
        made.width = static_cast<float>(made.texture->width());
        made.height = static_cast<float>(made.texture->height());
        const float* at = mesh.places.data();
        const auto place = [&](int k, int axis) {
            return at[2 * corners[k] + axis] * geom.repeat[axis] + geom.offset;
        };
        if (made.texture->is_cube) {
            const float(&scale)[3] = geom.cube;
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
    const Scene::Slot& slot = scene_.slots_[triangle.geom];
    const Vec3f* light = slot.light.data();
    const Vec3f l[3] = {light[corners[0]], light[corners[1]], light[corners[2]]};
    made.flat = !std::memcmp(&l[0], &l[1], sizeof l[0]) &&
                !std::memcmp(&l[0], &l[2], sizeof l[0]) && scene_.casters_.empty();
    if (made.flat) {
        made.same[0] = static_cast<std::uint16_t>(l[0].x * 65535.0f);
        made.same[1] = static_cast<std::uint16_t>(l[0].y * 65535.0f);
        made.same[2] = static_cast<std::uint16_t>(l[0].z * 65535.0f);
    } else {
        plane(made.light[0], l[0].x, l[1].x, l[2].x);
        plane(made.light[1], l[0].y, l[1].y, l[2].y);
        plane(made.light[2], l[0].z, l[1].z, l[2].z);
    }
    made.shades = static_cast<std::int32_t>(shades_.size());
    for (const Light& caster : scene_.casters_) {
        light += slot.light.size() / (1 + scene_.casters_.size());
        Vec3 at[3];  // of the corners, seen from the light
        for (int k = 0; k < 3; ++k) {
            const Vec3f p = mesh.points[corners[k]];
            const Pose &pose = slot.pose, &eye = caster.eye;
            const Vec3 turned = pose.turn * Vec3{p.x, p.y, p.z};
            at[k] = eye.turn.back({turned.x + (pose.position[0] - eye.position[0]),
                                   turned.y + (pose.position[1] - eye.position[1]),
                                   turned.z + (pose.position[2] - eye.position[2])});
        }
        const Vec3f a = light[corners[0]], b = light[corners[1]], c = light[corners[2]];
        const Corners from(at);
        Shade shade;
        shade.shines = a.x + a.y + a.z + b.x + b.y + b.z + c.x + c.y + c.z > 0;
        plane(shade.light[0], a.x, b.x, c.x);
        plane(shade.light[1], a.y, b.y, c.y);
        plane(shade.light[2], a.z, b.z, c.z);
        plane(shade.place[0], at[0].x, at[1].x, at[2].x);
        plane(shade.place[1], at[0].y, at[1].y, at[2].y);
        plane(shade.place[2], at[0].z, at[1].z, at[2].z);
        put(shade.depth, (from.edges[0] + from.edges[1] + from.edges[2]) * (1.0 / from.away));
        shades_.push_back(shade);
    }
    surfaces_.push_back(made);
    return surfaces_.back();
}

// How much of a light reaches points, which are seen from it: of four pixels of its map about each,
// those that see nothing before the triangle's plane, weighted by their distance. So no surface is
// in its own shadow, however steep.
static fv reaches(const Light& light, const Shade& shade, fv x, fv y, fv z) {
    const auto step = static_cast<float>(light.step), per_step = static_cast<float>(1 / light.step);
    const float middle = 0.5f * static_cast<float>(light.size - 1);
    const fv inverse = per_step / z, column = x * inverse + middle, row = y * inverse + middle;
    const iv inside = (column >= 0.0f) & (column < 2 * middle) & (row >= 0.0f) &
                      (row < 2 * middle) & (z > 0.0f);
    const fv left = floored(inside ? column : fv{}), top = floored(inside ? row : fv{});
    const fv right_share = column - left, lower_share = row - top;
    std::int32_t first[lanes];
    store(first, as_whole(top) * light.size + as_whole(left));
    fv lit{};
    for (int k = 0; k < 4; ++k) {
        const int right = k & 1, lower = k >> 1;
        float depths[lanes];
        for (int lane = 0; lane < lanes; ++lane)
            depths[lane] = light.map[first[lane] + right + lower * light.size];
        const fv across = (left + (right - middle)) * step, down = (top + (lower - middle)) * step;
        const fv plane = across * shade.depth[0] + (down * shade.depth[1] + shade.depth[2]);
        const fv share = (right ? right_share : 1.0f - right_share) *
                         (lower ? lower_share : 1.0f - lower_share);
        lit += load<fv>(depths) * plane < 1.0f - rounding ? fv{} : share;
    }
    return inside ? lit : fv{} + 1.0f;
}

static float times(const float (&plane)[3], Vec3f ray) {
    return plane[0] * ray.x + (plane[1] * ray.y + plane[2] * ray.z);
}

// Level of a mipmap, in 256ths, whose texels are as large as a pixel; `inverse` is its depth's.
template <bool pinhole>
inline int Band::detail(const Surface& surface, int x, int y, float inverse) const {
    const Vec3f here = lens_.ray(x, y);
    const float u = times(surface.u, here) * inverse, v = times(surface.v, here) * inverse;
    float width = inverse * surface.width, height = inverse * surface.height, w = 0;
    const bool is_cube = surface.texture->is_cube;
    if (is_cube) {
        w = times(surface.w, here) * inverse;
        const auto size = [](float value) { return value < 0 ? -value : value; };
        width *= 0.5f / std::max({size(u), size(v), size(w), 1e-20f}), height = width;
    }
    const auto step = [&](auto along) {  // how far a step moves, squared, texels
        const float dq = along(surface.depth);
        const float across = (along(surface.u) - u * dq) * width;
        const float down = (along(surface.v) - v * dq) * height;
        const float ahead = is_cube ? (along(surface.w) - w * dq) * width : 0.0f;
        return across * across + (down * down + ahead * ahead);
    };
    float most;
    if constexpr (pinhole) {
        const auto right = static_cast<float>(lens_.step[0]), below = static_cast<float>(lens_.step[1]);
        most = std::max(step([&](const float(&plane)[3]) { return plane[0] * right; }),
                        step([&](const float(&plane)[3]) { return plane[1] * below; }));
    } else {
        const Vec3f right = lens_.ray(std::min(x + 1, lens_.width - 1), y) - here;
        const Vec3f below = lens_.ray(x, std::min(y + 1, lens_.height - 1)) - here;
        most = std::max(step([&](const float(&plane)[3]) { return times(plane, right); }),
                        step([&](const float(&plane)[3]) { return times(plane, below); }));
    }
    if (!(most > 1.0f)) return 0;  // also where a ray's neighbour is none
    const int level = static_cast<int>(128.0f * log_2(std::min(most, 1e30f))) - sharper;
    return std::min(std::max(level, 0), (surface.texture->levels() - 1) << 8);
}

// Find out where the colours of `count` pixels of a triangle in a row come from, from x on.
template <bool pinhole>
void Band::place(const Surface& surface, int x, int y, const float* nearest, int count) {
    const Texture* texture = surface.texture;
    const int middle = count / 2;
    const int level =
        texture ? detail<pinhole>(surface, x + middle, y, 1.0f / nearest[middle]) : 0;
    const std::size_t row = pinhole ? 0 : std::size_t(y) * lens_.stride;
    for (const int end = x + count; x < end; x += lanes, nearest += lanes) {
        const fv inverse = 1.0f / load<fv>(nearest);
        const fv rx = load<fv>(&lens_.x[row + x]);
        const fv ry = pinhole ? fv{} + lens_.y[y] : load<fv>(&lens_.y[row + x]);
        const fv rz = pinhole ? fv{} + 1.0f : load<fv>(&lens_.z[row + x]);
        const auto times = [&](const float(&plane)[3]) {
            return (rx * plane[0] + (ry * plane[1] + rz * plane[2])) * inverse;
        };
        const auto share = [](fv part) {  // of 0 to 1, in 65536ths
            part = part > 0.0f ? part : fv{};
            return as_whole((part < 1.0f ? part : fv{} + 1.0f) * 65535.0f);
        };
        if (!texture) plain(x);
        else if (texture->is_cube)
            texture->around(taps_, x, times(surface.u), times(surface.v), times(surface.w), level);
        else texture->place(taps_, x, times(surface.u), times(surface.v), level);
        if (surface.flat) {
            taps_.set(Taps::red_blue, x, iv{} + (surface.same[0] | surface.same[2] << 16));
            taps_.set(Taps::green, x, iv{} + surface.same[1]);
        } else {
            fv light[3];
            for (int k = 0; k < 3; ++k) light[k] = times(surface.light[k]);
            const Shade* shade = shades_.data() + surface.shades;
            for (const Light& caster : scene_.casters_) {
                const Shade& of = *shade++;
                if (!of.shines) continue;
                const fv lit = reaches(caster, of, times(of.place[0]), times(of.place[1]),
                                       times(of.place[2]));
                for (int k = 0; k < 3; ++k) light[k] += lit * times(of.light[k]);
            }
            taps_.set(Taps::red_blue, x, share(light[0]) | share(light[2]) << 16);
            taps_.set(Taps::green, x, share(light[1]));
        }
        if (view_.fogged)
            taps_.set(Taps::clear, x, twice(share((view_.fog_end - inverse * rz) /
                                                  (view_.fog_end - view_.fog_start))));
    }
}

// White texels, the first ones of the scene, for pixels from x on.
void Band::plain(int x) {
    for (const int kind : {Taps::upper, Taps::lower, Taps::right, Taps::low, Taps::share})
        taps_.set(kind, x, iv{});
}

// Colours of pixels from x on, whose taps are set.
Colours Band::colours(int x) {
    const std::uint32_t* texels = scene_.texels.data();
    Colours mine = read(texels, taps_, x, 0);
    const iv share = taps_.get(Taps::share, x);
    if (const auto two = reinterpret_cast<wv>(share != 0); any(reinterpret_cast<iv>(two))) {
        const Colours both = between(mine, read(texels, taps_, x, 1), reinterpret_cast<wv>(share));
        mine = {(both.red_blue & two) | (mine.red_blue & ~two),
                (both.green & two) | (mine.green & ~two)};
    }
    mine = {high(mine.red_blue, taps_.weights(Taps::red_blue, x)),
            high(mine.green, taps_.weights(Taps::green, x))};
    if (!view_.fogged) return mine;
    const auto level = [&](int k) { return static_cast<int>(view_.fog[k] * 65280.0f); };
    const Colours fog{reinterpret_cast<wv>(iv{} + (level(0) | level(2) << 16)),
                      reinterpret_cast<wv>(iv{} + level(1))};
    return between(fog, mine, taps_.weights(Taps::clear, x));
}

// Write pixels and, where there is room, some bytes after them, which the next pixels overwrite.
void Band::write(std::uint8_t* to, Colours colours, int count) const {
    using u8x16 = std::uint8_t __attribute__((vector_size(16)));
    std::uint8_t pixels[4 * lanes];
    store(pixels, ((colours.red_blue + 128) >> 8) | ((colours.green + 128) & 0xff00));
    for (int k = 0; k < count; k += 4, to += 12) {
        const auto four = load<u8x16>(pixels + 4 * k);
        const u8x16 packed = RASTER_SHUFFLE(u8x16, four, four, 0, 1, 2, 4, 5, 6, 8, 9, 10, 12, 13,
                                            14, 15, 15, 15, 15);
        const std::ptrdiff_t room = end_ - to;
        if (room >= 16) store(to, packed);
        else std::memcpy(to, &packed, std::min<std::ptrdiff_t>(room, 12));
    }
}

void Band::shade() {
    for (int y = first_; y < last_; ++y) {
        runs(y, [&](int left, int right, std::int32_t number) {
            if (number < 0) place_sky(y, left, right);
            else place(y, left, right, number);
        });
        for (int x = 0; x < lens_.width; x += lanes)
            write(row(y) + 3 * x, colours(x), std::min(lens_.width - x, lanes));
    }
}

void Band::place(int y, int left, int right, std::int32_t number) {
    const Surface& surface = this->surface(number, y);
    for (; left < right; left += run) {
        const int count = std::min(right - left, run);
        const float* nearest = nearest_ + at(y) + left;
        if (lens_.pinhole) place<true>(surface, left, y, nearest, count);
        else place<false>(surface, left, y, nearest, count);
    }
}

void Band::place_sky(int y, int left, int right) {
    const double share = (y - scene_.start_) / scene_.step_;
    for (; left < right; left += lanes) {
        float rays[3][lanes] = {};
        for (int k = 0; k < lanes && left + k < right; ++k) {
            const Vec3f ray = lens_.ray(left + k, y);
            const Vec3 along{ray.x, ray.y, ray.z};
            const Vec3 from = scene_.eye_.turn * along, to = scene_.next_eye_.turn * along;
            const Vec3 world = from + (to - from) * share;
            rays[0][k] = static_cast<float>(world.x);
            rays[1][k] = static_cast<float>(world.z);
            rays[2][k] = static_cast<float>(-world.y);
        }
        const fv x = load<fv>(rays[0]), y = load<fv>(rays[1]), z = load<fv>(rays[2]);
        iv light{};  // none where no ray is, or no sky
        if (view_.sky >= 0) {
            scene_.textures[view_.sky]->around(taps_, left, x, y, z, 0);
            light = ((x != 0.0f) | (y != 0.0f) | (z != 0.0f));
        } else {
            plain(left);
        }
        taps_.set(Taps::red_blue, left, light);
        taps_.set(Taps::green, left, light & 65535);
        taps_.set(Taps::clear, left, iv{} - 1);
    }
}

// Blend a see-through triangle's colour into a pixel.
void Band::mix(int x, int y, float nearest, std::int32_t number) {
    const Surface& surface = this->surface(number, y);
    float inverse[widest];
    std::fill_n(inverse, widest, nearest);
    if (lens_.pinhole) place<true>(surface, x, y, inverse, 1);
    else place<false>(surface, x, y, inverse, 1);
    const Colours mine = colours(x);
    std::uint8_t* to = row(y) + 3 * x;
    const int levels[3] = {mine.red_blue[0], mine.green[0], mine.red_blue[1]};
    const int share = static_cast<int>(surface.opacity * 256.0f);
    for (int k = 0; k < 3; ++k)
        to[k] = static_cast<std::uint8_t>((to[k] * 256 * (256 - share) + levels[k] * share + 32768) >> 16);
}

}  // namespace raster
