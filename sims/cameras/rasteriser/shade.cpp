// What each pixel shows: runs of pixels of one triangle are shaded together.
#include <algorithm>

#include "band.hpp"
#include "lighting.hpp"

namespace raster {

constexpr float rounding = 2e-6f;  // of a depth by the inverse depth of the plane that it is on

// Light on a geom's vertices; that of before, if nothing has moved. Of what moves, few triangles may
// be seen, and only their corners are lit then (`Band::surface`).
void Scene::light(const Geom& geom, const Pose& pose, Slot& slot) const {
    if (slot.frame == frame_) return;
    slot.frame = frame_;
    bool shines = false;
    for (const Light& each : lights_)
        shines |= geom.specular > 0 && (each.specular[0] + each.specular[1] + each.specular[2]) > 0;
    const bool rests = !std::memcmp(&slot.geom, &geom, sizeof geom) &&
                       !std::memcmp(&slot.pose, &pose, sizeof pose);
    slot.geom = geom, slot.pose = pose;
    if (!rests) slot.light.clear();
    if ((!rests && view_.poses == 1) || (!shines && !slot.light.empty())) return;
    const std::size_t count = meshes[geom.mesh]->points.size();
    const std::size_t side = count * (1 + casters_.size());
    slot.light.resize(geom.double_sided ? 2 * side : side);
    for (std::size_t k = 0; k < count; ++k) {
        light(slot, static_cast<int>(k), false, &slot.light[k], count);
        if (geom.double_sided) light(slot, static_cast<int>(k), true, &slot.light[side + k], count);
    }
}

// Light on one vertex, on its front or back; after it, so far apart, that of each light that throws
// shadows.
void Scene::light(const Slot& slot, int vertex, bool behind, Vec3f* to, std::size_t apart) const {
    const Mesh& mesh = *meshes[slot.geom.mesh];
    const Pose& pose = slot.pose;
    const Vec3 eye{middle_eye_.position[0], middle_eye_.position[1], middle_eye_.position[2]};
    const Vec3 origin{pose.position[0], pose.position[1], pose.position[2]};
    const Vec3f p = mesh.points[vertex], n = mesh.normals[vertex];
    const Vec3 normal = unit(pose.turn * Vec3{n.x, n.y, n.z});
    const Vec3 point = pose.turn * Vec3{p.x, p.y, p.z} + origin;
    Geom coloured = slot.geom;
    if (!mesh.colours.empty())
        for (int part = 0; part < 3; ++part) coloured.rgba[part] *= mesh.colours[4 * vertex + part];
    lit(coloured, lights_, point, behind ? normal * -1.0 : normal, eye, to, apart);
}

// Number of a triangle's surface: the planes of all that is interpolated on it, computed when its
// first pixel is shaded; while it moves, those of a row.
std::int32_t Band::surface(std::int32_t number, int y) {
    const bool rolling = view_.poses > 1;
    const auto index = static_cast<std::int32_t>(surfaces_.size());
    if (!rolling) {
        std::int32_t& known = surface_of(number);
        if (known >= 0) return known;
        known = index;
    }
    const Triangle& triangle = this->triangle(number);
    const Placed& placed = scene_.placed_[triangle.geom];
    const Geom& geom = *placed.geom;
    const Mesh& mesh = *placed.mesh;
    const std::int32_t* corners = mesh.corners.data() + triangle.corner;
    const Corners seen =
        rolling ? between_poses(number, y)
                : Corners({placed.seen[corners[0]], placed.seen[corners[1]], placed.seen[corners[2]]});
    const double share = inverse(seen.away());
    const d4 weights[3] = {seen.edge(1) * share, seen.edge(2) * share, seen.edge(0) * share};
    const auto plane = [&](float (&to)[3], float a, float b, float c) {
        put(to, weights[0] * double(a) + weights[1] * double(b) + weights[2] * double(c));
    };
    Surface& made = surfaces_.emplace_back();
    made.part = triangle.part, made.number = geom.number;
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
    const bool behind = geom.double_sided && seen.away() > 0;
    std::size_t apart = mesh.points.size();
    std::int32_t of[3] = {corners[0], corners[1], corners[2]};
    if (slot.light.empty()) {
        apart = 3;
        light_.resize(apart * (1 + scene_.casters_.size()));
        for (int k = 0; k < 3; ++k)
            scene_.light(slot, corners[k], behind, &light_[k], apart), of[k] = k;
        light = light_.data();
    } else if (behind) {
        light += slot.light.size() / 2;
    }
    const Vec3f l[3] = {light[of[0]], light[of[1]], light[of[2]]};
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
        light += apart;
        const Vec3f a = light[of[0]], b = light[of[1]], c = light[of[2]];
        Shade& shade = shades_.emplace_back();
        shade.shines = a.x + a.y + a.z + b.x + b.y + b.z + c.x + c.y + c.z > 0;
        if (!shade.shines) continue;
        Vec3 at[3];  // of the corners, seen from the light
        for (int k = 0; k < 3; ++k) {
            const Vec3f p = mesh.points[corners[k]];
            const Pose &pose = slot.pose, &eye = caster.eye;
            const Vec3 turned = pose.turn * Vec3{p.x, p.y, p.z};
            at[k] = eye.turn.back({turned.x + (pose.position[0] - eye.position[0]),
                                   turned.y + (pose.position[1] - eye.position[1]),
                                   turned.z + (pose.position[2] - eye.position[2])});
        }
        const Corners from(at);
        plane(shade.light[0], a.x, b.x, c.x);
        plane(shade.light[1], a.y, b.y, c.y);
        plane(shade.light[2], a.z, b.z, c.z);
        plane(shade.place[0], at[0].x, at[1].x, at[2].x);
        plane(shade.place[1], at[0].y, at[1].y, at[2].y);
        plane(shade.place[2], at[0].z, at[1].z, at[2].z);
        put(shade.depth, (from.edge(0) + from.edge(1) + from.edge(2)) * inverse(from.away()));
        std::uint32_t words[3];
        std::memcpy(words, shade.depth, sizeof words);
        shade.spread = (words[0] + 31 * words[1] + 961 * words[2]) * 2654435761u >> 16;
    }
    return index;
}

// How much of a light reaches points, which are seen from it: of four pixels of its map about each,
// those that see nothing before the triangle's plane, weighted by their distance. So no surface is
// in its own shadow, however steep. Where the first `count` points are in an area that is lit or
// dark as a whole, no pixel is looked at.
static fv reaches(const Light& light, const Shade& shade, const Area& area, fv x, fv y, fv z,
                  int count) {
    const auto step = static_cast<float>(light.step), per_step = static_cast<float>(1 / light.step);
    const float middle = 0.5f * static_cast<float>(light.size - 1);
    const fv inverse = per_step / z, column = x * inverse + middle, row = y * inverse + middle;
    const auto within = [&](float left, float right, float top, float bottom) {
        return (column >= left) & (column < right) & (row >= top) & (row < bottom) & (z > 0.0f);
    };
    const auto shares = [](fv right, fv lower, fv (&to)[4]) {
        const fv left = 1.0f - right, upper = 1.0f - lower;
        to[0] = left * upper, to[1] = right * upper, to[2] = left * lower, to[3] = right * lower;
    };
    fv share[4];
    if (area.state) {
        const iv there = within(area.left, area.right, area.top, area.bottom);
        if (!(~bits(there) & ((1 << std::min(count, lanes)) - 1))) {
            if (area.state == all_dark) return fv{};
            shares(column - floored(column), row - floored(row), share);
            return share[0] + share[1] + share[2] + share[3];
        }
    }
    const iv inside = within(0, 2 * middle, 0, 2 * middle);
    const fv left = floored(inside ? column : fv{}), top = floored(inside ? row : fv{});
    shares(column - left, row - top, share);
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
        lit += load<fv>(depths) * plane < 1.0f - rounding ? fv{} : share[k];
    }
    return inside ? lit : fv{} + 1.0f;
}

// The tiles of a light's map about the two ends of a span, if they are few and it is known of them
// all that they are lit, or dark.
Area Band::area(std::int32_t caster, const Shade& shade, const Span& span, int y) {
    const Light& light = scene_.casters_[caster];
    const float middle = 0.5f * static_cast<float>(light.size - 1), end = 2 * middle;
    const auto per_step = static_cast<float>(1 / light.step);
    float low[2] = {end, end}, high[2] = {0, 0};
    for (const int x : {span.x, span.x + span.count - 1}) {
        const Vec3f ray = lens_.ray(x, y);
        const auto times = [&](int k) {
            const float(&plane)[3] = shade.place[k];
            return ray.x * plane[0] + (ray.y * plane[1] + ray.z * plane[2]);
        };
        const float share = per_step / times(2);
        for (int k = 0; k < 2; ++k) {
            const float at = times(k) * share + middle;
            if (!(at >= 0 && at < end)) return {};
            low[k] = std::min(low[k], at), high[k] = std::max(high[k], at);
        }
    }
    constexpr int most = 6;
    constexpr float near = 0.01f;  // a little more, for rounding
    int from[2], to[2];
    for (int k = 0; k < 2; ++k) {
        from[k] = static_cast<int>(std::max(low[k] - near, 0.0f)) / tile_side;
        to[k] = static_cast<int>(high[k] + near) / tile_side + 1;
    }
    if ((to[0] - from[0]) * (to[1] - from[1]) > most) return {};
    int state = all_lit | all_dark;
    const bool look = span.count >= lanes;
    for (int row = from[1]; row < to[1]; ++row)
        for (int column = from[0]; column < to[0]; ++column)
            if (!(state &= tile(caster, shade, column, row, look))) return {};
    const auto edge = [&](int tiles) { return std::min(float(tiles * tile_side), end); };
    return {state, edge(from[0]), edge(to[0]), edge(from[1]), edge(to[1])};
}

// What is known of the pixels of a tile of a light's map, and those to its right and below it, on a
// triangle: `all_lit`, `all_dark` or 0, by the same arithmetic as above; 0 if that is not known and
// not worth a look. It stays known until the map is drawn there.
int Band::tile(std::int32_t caster, const Shade& shade, int column, int row, bool look) {
    constexpr std::uint32_t known = 4096;
    const Light& light = scene_.casters_[caster];
    const std::int32_t place = row * tiles_across(light.size) + column;
    const std::uint32_t change = light.changes[place];
    if (tiles_.empty()) tiles_.resize(known);
    Tile& tile = tiles_[(shade.spread + 64 * row + column) & (known - 1)];
    if (tile.place == place && tile.caster == caster && tile.change == change &&
        !std::memcmp(tile.depth, shade.depth, sizeof shade.depth))
        return tile.state;
    if (!look) return 0;
    const auto step = static_cast<float>(light.step);
    const float middle = 0.5f * static_cast<float>(light.size - 1);
    fv count{};
    for (int lane = 0; lane < lanes; ++lane) count[lane] = static_cast<float>(lane);
    const int left = column * tile_side, top = row * tile_side;
    const int bottom = std::min(top + tile_side, light.size - 1);
    iv lit{}, dark{};
    for (int x = 0; x <= tile_side; x += lanes) {
        const int first = left + std::min(x, tile_side + 1 - lanes);
        const fv across = (count + (first - middle)) * step * shade.depth[0];
        const float* depths = light.map + std::size_t(top) * light.size + first;
        for (int y = top; y <= bottom; ++y, depths += light.size) {
            const float down = (y - middle) * step;
            const fv plane = across + (down * shade.depth[1] + shade.depth[2]);
            const iv is_dark = load<fv>(depths) * plane < 1.0f - rounding;
            dark |= is_dark, lit |= ~is_dark;
        }
    }
    tile = {caster, place, change, {}, any(dark) ? any(lit) ? 0 : all_dark : all_lit};
    std::memcpy(tile.depth, shade.depth, sizeof shade.depth);
    return tile.state;
}

// Find the levels of mipmaps whose texels are as large as a pixel in the middle of each span.
template <bool pinhole>
void Band::find_levels(int y) {
    static constexpr Surface none{};
    const int count = static_cast<int>(spans_.size());
    for (int first = 0; first < count; first += lanes) {
        float planes[4][3][lanes], sizes[2][lanes], rays[3][3][lanes], nearest[lanes];
        std::int32_t cubes[lanes], levels[lanes];
        for (int lane = 0; lane < lanes; ++lane) {
            const Span& span = spans_[std::min(first + lane, count - 1)];
            const bool textured = span.surface >= 0 && surfaces_[span.surface].texture;
            const Surface& surface = textured ? surfaces_[span.surface] : none;
            for (int k = 0; k < 3; ++k) {
                planes[0][k][lane] = surface.u[k], planes[1][k][lane] = surface.v[k];
                planes[2][k][lane] = surface.w[k], planes[3][k][lane] = surface.depth[k];
            }
            sizes[0][lane] = surface.width, sizes[1][lane] = surface.height;
            cubes[lane] = textured && surface.texture->is_cube ? -1 : 0;
            levels[lane] = textured ? (surface.texture->levels() - 1) << 8 : 0;
            nearest[lane] = span.nearest;
            const int x = span.x + span.count / 2;
            const auto put = [&](int which, Vec3f ray) {
                rays[which][0][lane] = ray.x, rays[which][1][lane] = ray.y;
                rays[which][2][lane] = ray.z;
            };
            const Vec3f here = lens_.ray(x, y);
            put(0, here);
            if constexpr (pinhole) continue;
            put(1, lens_.ray(std::min(x + 1, lens_.width - 1), y) - here);
            put(2, lens_.ray(x, std::min(y + 1, lens_.height - 1)) - here);
        }
        const auto times = [&](int plane, int ray) {
            if (pinhole && ray)
                return load<fv>(planes[plane][ray - 1]) * static_cast<float>(lens_.step[ray - 1]);
            const auto product = [&](int k) {
                return load<fv>(planes[plane][k]) * load<fv>(rays[ray][k]);
            };
            return product(0) + (product(1) + product(2));
        };
        const fv inverse = 1.0f / load<fv>(nearest);
        const fv u = times(0, 0) * inverse, v = times(1, 0) * inverse, w = times(2, 0) * inverse;
        const auto size = [](fv value) { return value < 0.0f ? -value : value; };
        const auto larger = [](fv a, fv b) { return a < b ? b : a; };
        fv width = inverse * load<fv>(sizes[0]), height = inverse * load<fv>(sizes[1]);
        const iv cube = load<iv>(cubes);
        const fv share = 0.5f / larger(larger(size(u), size(v)), larger(size(w), fv{} + 1e-20f));
        width = cube ? width * share : width, height = cube ? width : height;
        const auto step = [&](int ray) {  // how far a step moves, squared, texels
            const fv dq = times(3, ray), across = (times(0, ray) - u * dq) * width;
            const fv down = (times(1, ray) - v * dq) * height;
            const fv ahead = cube ? (times(2, ray) - w * dq) * width : fv{};
            return across * across + (down * down + ahead * ahead);
        };
        const fv most = larger(step(1), step(2));
        const fv within = most < 1e30f ? most : fv{} + 1e30f;
        iv level = as_whole(128.0f * log_2(within)) - sharper;
        level = level < 0 ? iv{} : level;
        level = level < load<iv>(levels) ? level : load<iv>(levels);
        level = most > 1.0f ? level : iv{};  // also where a ray's neighbour is none
        store(levels, level);
        for (int lane = 0; lane < lanes && first + lane < count; ++lane)
            spans_[first + lane].level = levels[lane];
    }
}

// Find out where the colours of pixels side by side come from, whose inverse depths these are.
template <bool pinhole>
void Band::place(const Span& span, int y, const float* nearest) {
    const Surface& surface = surfaces_[span.surface];
    const Texture* texture = surface.texture;
    const int level = span.level;
    int x = span.x;
    const auto casters = static_cast<std::int32_t>(scene_.casters_.size());
    areas_.resize(casters);
    for (std::int32_t caster = 0; caster < casters; ++caster)
        if (const Shade& shade = shades_[surface.shades + caster]; shade.shines)
            areas_[caster] = area(caster, shade, span, y);
    const std::size_t row = pinhole ? 0 : std::size_t(y) * lens_.stride;
    for (const int end = x + span.count; x < end; x += lanes, nearest += lanes) {
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
            for (std::int32_t caster = 0; caster < casters; ++caster) {
                const Shade& of = shades_[surface.shades + caster];
                if (!of.shines) continue;
                const fv lit =
                    reaches(scene_.casters_[caster], of, areas_[caster], times(of.place[0]),
                            times(of.place[1]), times(of.place[2]), end - x);
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
    Colours mine = read(taps_, x, 0);
    const iv share = taps_.get(Taps::share, x);
    if (const auto two = reinterpret_cast<wv>(share != 0); any(reinterpret_cast<iv>(two))) {
        const Colours both = between(mine, read(taps_, x, 1), reinterpret_cast<wv>(share));
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

// Have what the surfaces of the next runs of a row are made of on its way from memory, in three
// steps: where small triangles are many, to wait for it takes longest.
void Band::prefetch(int run) const {
    const auto of = [&](int ahead) {
        const std::size_t at = run + ahead;
        return at < runs_.size() && runs_[at].number >= 0 ? &triangle(runs_[at].number) : nullptr;
    };
    if (const Triangle* triangle = of(24)) __builtin_prefetch(&triangle->geom);
    if (const Triangle* triangle = of(16))
        __builtin_prefetch(&scene_.placed_[triangle->geom].mesh->corners[triangle->corner]);
    if (const Triangle* triangle = of(8)) {
        const Placed& placed = scene_.placed_[triangle->geom];
        const std::vector<Vec3f>& light = scene_.slots_[triangle->geom].light;
        for (int k = 0; k < 3; ++k) {
            const std::int32_t corner = placed.mesh->corners[triangle->corner + k];
            __builtin_prefetch(&placed.seen[corner]);
            __builtin_prefetch(&placed.mesh->places[2 * corner]);
            if (!light.empty()) __builtin_prefetch(&light[corner]);
        }
    }
}

void Band::shade() {
    std::vector<std::int32_t> rows[2];  // parts that pixels of a row, and of that above, see
    for (auto& row : rows) row.resize(lens_.stride + widest);
    std::vector<std::int32_t> numbers(images_.numbers ? lens_.stride + widest : 0);
    std::vector<int> ends;  // columns of pixels right of which another part is seen
    for (int y = first_; y < last_; ++y) {
        std::int32_t* parts = rows[y & 1].data();
        spans_.clear(), ends.clear();
        if (view_.poses > 1) surfaces_.clear(), shades_.clear();
        runs_.clear();
        runs(y, [&](int left, int right, std::int32_t number) { runs_.push_back({left, right, number}); });
        for (int k = 0; k < static_cast<int>(runs_.size()); ++k) {
            prefetch(k);
            auto [left, right, number] = runs_[k];
            const std::int32_t seen = number < 0 ? -1 : surface(number, y);
            const std::int32_t part = seen < 0 ? -1 : surfaces_[seen].part;
            if (left && part != parts[left - 1]) ends.push_back(left - 1);
            for (int x = left; x < right; x += lanes) store(parts + x, iv{} + part);
            if (!numbers.empty()) {
                const iv number_of = iv{} + (seen < 0 ? -1 : surfaces_[seen].number);
                for (int x = left; x < right; x += lanes) store(&numbers[x], number_of);
            }
            for (int count; left < right; left += count) {
                count = seen < 0 ? right - left : std::min(right - left, most_side_by_side);
                spans_.push_back({seen, left, count, 0, nearest_[at(y) + left + count / 2]});
            }
        }
        if (lens_.pinhole) place<true>(y);
        else place<false>(y);
        for (int x = 0; x < lens_.width; x += lanes)
            write(row(y) + 3 * x, colours(x), std::min(lens_.width - x, lanes));
        if (!numbers.empty())
            std::copy_n(numbers.data(), lens_.width,
                        images_.numbers + std::size_t(y - view_.first) * lens_.width);
        for (const int x : ends) smooth(x, y, false);
        if (y == first_) first_row_ = outlines_.size();
        else find_below(y, rows[~y & 1].data(), parts);
    }
}

template <bool pinhole>
void Band::place(int y) {
    find_levels<pinhole>(y);
    for (const Span& span : spans_)
        if (span.surface < 0) place_sky(y, span.x, span.x + span.count);
        else place<pinhole>(span, y, nearest_ + at(y) + span.x);
}

void Band::place_sky(int y, int left, int right) {
    const double share = this->share(y);
    for (; left < right; left += lanes) {
        float rays[3][lanes] = {};
        for (int k = 0; k < lanes && left + k < right; ++k) {
            const Vec3f ray = lens_.ray(left + k, y);
            const Vec3 along{ray.x, ray.y, ray.z};
            Vec3 world = scene_.eye_.turn * along;
            if (view_.poses > 1)
                world = world + (scene_.next_eye_.turn * along - world) * share;
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
    if (view_.poses > 1) surfaces_.clear(), shades_.clear();
    const std::int32_t seen = surface(number, y);
    spans_.assign(1, {seen, x, 1, 0, nearest});
    float inverse[widest];
    std::fill_n(inverse, widest, nearest);
    if (lens_.pinhole) find_levels<true>(y), place<true>(spans_[0], y, inverse);
    else find_levels<false>(y), place<false>(spans_[0], y, inverse);
    const Surface& surface = surfaces_[seen];
    const Colours mine = colours(x);
    std::uint8_t* to = row(y) + 3 * x;
    const int levels[3] = {mine.red_blue[0], mine.green[0], mine.red_blue[1]};
    const int share = static_cast<int>(surface.opacity * 256.0f);
    for (int k = 0; k < 3; ++k)
        to[k] = static_cast<std::uint8_t>((to[k] * 256 * (256 - share) + levels[k] * share + 32768) >> 16);
}

}  // namespace raster
