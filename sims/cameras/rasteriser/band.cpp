// Which triangle each pixel of a band sees.
#include "band.hpp"
#include "lighting.hpp"

#include <algorithm>
#include <limits>

namespace raster {

constexpr int parts_from = 24;  // bit of a triangle's number; those before count within its part
constexpr std::int32_t clear_part = 1 << 30;

Band::Band(Scene& scene, int first, int last, const Images& images, Memory& memory)
    : scene_(scene), lens_(*scene.lens_), view_(scene.view_), first_(first), last_(last),
      images_(images), end_(images.rgb ? row(last) : nullptr), nearest_(scene.nearest_.data()),
      visible_(scene.visible_.data()), tiles_(memory.tiles), taps_(lens_.stride, scene.texels),
      farthest_(lens_.pinhole ? 0 : leaf(0, last + Lens::smallest)), surfaces_(memory.surfaces),
      shades_(memory.shades), surface_of_(memory.surface_of) {
    surfaces_.clear(), shades_.clear();
    surface_of_.resize(scene.solid_.size() + scene.clear_.size());
    for (auto& known : surface_of_) known.clear();
}

void Band::clear() {
    std::fill(nearest_ + at(first_), nearest_ + at(last_), 0.0f);
    std::fill(visible_ + at(first_), visible_ + at(last_), -1);
    covered_.assign(scene_.solid_.size(), 0);
}

const Triangle& Band::triangle(std::int32_t number) const {
    const auto& parts = number & clear_part ? scene_.clear_ : scene_.solid_;
    return parts[(number & ~clear_part) >> parts_from][number & ((1 << parts_from) - 1)];
}

const Moving& Band::moving(std::int32_t number) const {
    const auto& parts = number & clear_part ? scene_.clear_moving_ : scene_.solid_moving_;
    return parts[(number & ~clear_part) >> parts_from][number & ((1 << parts_from) - 1)];
}

Corners Band::between_poses(std::int32_t number, int y) const {
    const Moving& moving = this->moving(number);
    return {moving.from, moving.to, share(y)};
}

// Makes a triangle as a row sees it; false if it does not.
bool Band::seen(Triangle& row, std::int32_t number, int y) const {
    const Corners corners = between_poses(number, y);
    row.planes = Planes(corners), row.behind = corners.away() > 0;
    return !(corners.away() >= 0) || (row.behind && scene_.placed_[row.geom].geom->double_sided);
}

std::int32_t& Band::surface_of(std::int32_t number) {
    const std::size_t solid = scene_.solid_.size();
    const bool is_clear = number & clear_part;
    const std::size_t part = (number & ~clear_part) >> parts_from;
    std::vector<std::int32_t>& known = surface_of_[part + (is_clear ? solid : 0)];
    if (known.empty()) known.assign((is_clear ? scene_.clear_ : scene_.solid_)[part].size(), -1);
    return known[number & ((1 << parts_from) - 1)];
}

void Band::cover() {
    for (std::size_t part = 0; part < covered_.size(); ++part)
        for (std::size_t& next = covered_[part]; next < scene_.solid_[part].size(); ++next) {
            if (next + 8 < scene_.solid_[part].size()) prefetch(scene_.solid_[part][next + 8]);
            cover(scene_.solid_[part][next], static_cast<std::int32_t>(part << parts_from | next));
        }
}

// Have the first pixels of a triangle on their way from memory.
void Band::prefetch(const Triangle& triangle) const {
    const int first = std::max(triangle.top, first_);
    const int last = std::min({triangle.bottom, last_, first + 4});
    for (int y = first; y < last; ++y) {
        __builtin_prefetch(nearest_ + at(y) + triangle.left, 1);
        __builtin_prefetch(visible_ + at(y) + triangle.left, 1);
    }
}

void Band::hide() {
    iv lane{};
    for (int k = 0; k < lanes; ++k) lane[k] = k;
    for (int top = first_, end; top < last_; top = end) {
        end = std::min((top / Lens::smallest + 1) * Lens::smallest, last_);
        for (int left = 0; left < lens_.width; left += Lens::smallest) {
            fv least = fv{} + 1e30f;
            for (int x = left; x < left + Lens::smallest; x += lanes) {
                const iv in_image = lane < lens_.width - x;
                for (int y = top; y < end; ++y) {
                    const fv here = load<fv>(nearest_ + at(y) + x);
                    least = in_image & (here < least) ? here : least;
                }
            }
            float all = least[0];
            for (int k = 1; k < lanes; ++k) all = std::min(all, least[k]);
            scene_.hiding_[scene_.tile(left, top)] = all;
        }
    }
}

void Band::finish() {
    smooth_outlines();
    if (images_.numbers && !images_.rgb)  // else they are known by now
        for (int y = first_; y < last_; ++y)
            runs(y, [&](int left, int right, std::int32_t seen) {
                number(y, left, right,
                       seen < 0 ? -1 : scene_.placed_[triangle(seen).geom].geom->number);
            });
    blend();
    if (images_.depth) measure();
}

// Call found(y, x, inside, inverse depth) for pixels side by side, some of them in a triangle.
template <typename Found>
inline void Band::over(const Triangle& triangle, std::int32_t number, Found found) {
    if (triangle.top >= last_ || triangle.bottom <= first_) return;
    const Placed& placed = scene_.placed_[triangle.geom];
    if (!lens_.pinhole) {
        Triangle later = triangle;
        if (view_.poses > 1) later.planes = Planes(moving(number).to);
        // The squares about the pixels where it may be, if these are less than the geom's.
        int side = 2 * Lens::smallest;
        while (side < std::max(triangle.right - triangle.left, triangle.bottom - triangle.top))
            side *= 2;
        if (side >= placed.side)
            return over_square(triangle, later, number, placed.square, placed.column, placed.row,
                               placed.side, found);
        for (int row = triangle.top / side * side; row < triangle.bottom; row += side)
            for (int column = triangle.left / side * side; column < triangle.right; column += side)
                if (const int square = lens_.square(side, column, row); square >= 0)
                    over_square(triangle, later, number, square, column, row, side, found);
        return;
    }
    if (view_.poses == 1) return scan_frame(triangle, triangle.top, triangle.bottom, found);
    Triangle row = triangle;
    const Moving& moving = this->moving(number);
    constexpr int most = 32;  // rows whose planes are found together: that is quicker
    Planes planes[most];
    bool met[most];
    const bool double_sided = placed.geom->double_sided;
    const int end = std::min(triangle.bottom, last_);
    for (int y = std::max(triangle.top, first_); y < end; y += most) {
        const int count = std::min(end - y, most);
        for (int k = 0; k < count; ++k) {
            const Corners corners(moving.from, moving.to, share(y + k));
            planes[k] = Planes(corners), met[k] = !(corners.away() >= 0);
            met[k] |= double_sided && corners.away() > 0;
        }
        for (int k = 0; k < count; ++k)
            if (row.planes = planes[k]; met[k]) scan_frame(row, y + k, y + k + 1, found);
    }
}

template <typename Found>
inline void Band::scan_frame(const Triangle& triangle, int top, int bottom, Found found) {
    const Vec3f e[3] = {triangle.planes[0], triangle.planes[1], triangle.planes[2]};
    const Vec3f d = triangle.planes.depth();
    const fv nearest = fv{} + 1.0f / view_.near;
    const int left = triangle.left & ~(lanes - 1);
    const bool wide = triangle.right - left > 4 * lanes;
    const float start = lens_.x[0], steps = static_cast<float>(1.0 / lens_.step[0]);
    float slope[3];  // of the columns in which the edges are, by row
    for (int k = 0; k < 3; ++k) slope[k] = wide && e[k].x != 0 ? -1.0f / e[k].x : 0;
    bottom = std::min(bottom, last_);
    for (int y = std::max(top, first_); y < bottom; ++y) {
        const float down = lens_.y[y];
        float in[3];
        for (int k = 0; k < 3; ++k) in[k] = e[k].y * down + e[k].z;
        const float depth = d.y * down + d.z;
        int from = left, to = triangle.right;
        if (wide) {  // the columns between the edges, and a few more for rounding
            float low = lens_.x[triangle.left], high = lens_.x[triangle.right - 1];
            for (int k = 0; k < 3; ++k) {
                if (e[k].x > 0) low = std::max(low, in[k] * slope[k]);
                if (e[k].x < 0) high = std::min(high, in[k] * slope[k]);
            }
            const float begin = (low - start) * steps - 3, end = (high - start) * steps + 4;
            if (!(begin < end)) continue;
            if (begin > from) from = static_cast<int>(begin) & ~(lanes - 1);
            if (end < to) to = static_cast<int>(end);
        }
        for (int x = from; x < to; x += lanes) {
            const fv rays = load<fv>(&lens_.x[x]), q = rays * d.x + depth;
            const iv inside = (rays * e[0].x + in[0] >= 0.0f) & (rays * e[1].x + in[1] >= 0.0f) &
                              (rays * e[2].x + in[2] >= 0.0f) & (q > 0.0f) & (q <= nearest);
            found(y, x, inside, q);
        }
    }
}

// In the parts of a square of rays that the triangle does not miss, neither now nor later: those of
// large squares must come near the ball about it, and those of small ones not be all beyond an edge,
// behind, or hidden.
template <typename Found>
void Band::over_square(const Triangle& triangle, const Triangle& later, std::int32_t number,
                       int square, int column, int row, int side, Found found) {
    const Lens::Square& rays = lens_.squares[square];
    i4 met = (rays.low[2] <= rays.high[2]) & (most(rays, triangle.ahead) >= triangle.least);
    i4 whole{};
    f4 nearest{};
    if (side <= Lens::small) {
        const auto reach = [&](int plane) {
            const f4 one = most(rays, triangle.planes[plane]);
            if (view_.poses == 1) return one;
            const f4 other = most(rays, later.planes[plane]);
            return one < other ? other : one;
        };
        for (int k = 0; k < 3; ++k) met &= reach(k) >= 0.0f;
        nearest = reach(3);
        met &= nearest >= 0.0f;
        if (side == 2 * Lens::smallest && view_.poses == 1) {
            whole = met;
            for (int k = 0; k < 3; ++k)
                whole &= most(rays, triangle.planes[k] * -1.0f) <= 0.0f;
        }
    }
    side /= 2;
    for (int left_over = bits(met); left_over; left_over &= left_over - 1) {
        const int part = __builtin_ctz(left_over);
        const int left = column + part % 2 * side, top = row + part / 2 * side;
        if (top >= triangle.bottom || top + side <= triangle.top) continue;
        if (left >= triangle.right || left + side <= triangle.left) continue;
        if (top >= last_ || top + side <= first_) continue;
        if (rays.parts[part] >= 0)
            over_square(triangle, later, number, rays.parts[part], left, top, side, found);
        else if (!(nearest[part] * 1.00001f <= farthest_[leaf(left, top)]))
            over_leaf(triangle, number, whole[part], left, top, found);
    }
}

// In the smallest square of a lens.
template <typename Found>
inline void Band::over_leaf(const Triangle& triangle, std::int32_t number, bool whole, int left,
                            int top, Found found) {
    const int from = std::max({top, first_, triangle.top});
    const int to = std::min({top + Lens::smallest, last_, triangle.bottom});
    const int right = std::min(left + Lens::smallest, lens_.stride);
    bool touched = false;
    if (view_.poses == 1) {
        touched = scan_pixels(triangle, whole, left, right, from, to, found);
    } else {
        Triangle row = triangle;
        for (int y = from; y < to; ++y)
            if (seen(row, number, y)) touched |= scan_pixels(row, false, left, right, y, y + 1, found);
    }
    if (!touched) return;
    fv least = fv{} + 1e30f;
    for (int y = std::max(top, first_); y < std::min(top + Lens::smallest, last_); ++y)
        for (int x = left; x < right; x += lanes) {
            const fv here = load<fv>(nearest_ + at(y) + x);
            least = here < least ? here : least;
        }
    float all = least[0];
    for (int k = 1; k < lanes; ++k) all = std::min(all, least[k]);
    farthest_[leaf(left, top)] = all;
}

// In some pixels, all of them within its edges if so said; false if the triangle is in none.
template <typename Found>
inline bool Band::scan_pixels(const Triangle& triangle, bool whole, int left, int right, int top,
                              int bottom, Found found) const {
    const Vec3f e[3] = {triangle.planes[0], triangle.planes[1], triangle.planes[2]};
    const Vec3f depth = triangle.planes.depth();
    const fv nearest = fv{} + 1.0f / view_.near;
    const float *xs = lens_.x.data(), *ys = lens_.y.data(), *zs = lens_.z.data();
    const std::size_t stride = lens_.stride;
    bool touched = false;
    for (int y = top; y < bottom; ++y)
        for (int x = left; x < right; x += lanes) {
            const std::size_t here = y * stride + x;
            const fv rx = load<fv>(xs + here), ry = load<fv>(ys + here), rz = load<fv>(zs + here);
            const auto times = [&](Vec3f p) { return rx * p.x + (ry * p.y + rz * p.z); };
            const fv q = times(depth);
            iv inside = (q > 0.0f) & (q <= nearest);
            if (!whole)
                inside &= (times(e[0]) >= 0.0f) & (times(e[1]) >= 0.0f) & (times(e[2]) >= 0.0f);
            if (!any(inside)) continue;
            found(y, x, inside, q);
            touched = true;
        }
    return touched;
}

void Band::cover(const Triangle& triangle, std::int32_t number) {
    if (scene_.placed_[triangle.geom].thresholds) return cover_cut(triangle, number);
    const iv mine = iv{} + number;
    const auto found = [mine, nearest = nearest_, visible = visible_, first = view_.first,
                        stride = std::size_t(lens_.stride)](int y, int x, iv inside, fv q)
        __attribute__((always_inline)) {
        const std::size_t here = (y - first) * stride + x;
        const fv before = load<fv>(nearest + here);
        const iv wins = inside & (q > before);
        store(nearest + here, wins ? q : before);
        store(visible + here, wins ? mine : load<iv>(visible + here));
    };
    over(triangle, number, found);
}

void Band::shadow(const Triangle& triangle) {
    if (scene_.placed_[triangle.geom].thresholds) return shadow_cut(triangle);
    const auto nearer = [map = images_.depth, size = std::size_t(lens_.width)](
                            int y, int x, iv inside, fv q) __attribute__((always_inline)) {
        float* here = map + y * size + x;
        const fv before = load<fv>(here), depth = 1.0f / q;
        store(here, inside & (depth < before) ? depth : before);
    };
    over(triangle, 0, nearer);
}

// What decides where a triangle with a cutoff is drawn, seen so.
Band::Opacity Band::opacity(const Triangle& triangle, const Corners& seen) const {
    const Placed& placed = scene_.placed_[triangle.geom];
    const Geom& geom = *placed.geom;
    const Mesh& mesh = *placed.mesh;
    const std::int32_t* corners = mesh.corners.data() + triangle.corner;
    const double share = inverse(seen.away());
    const d4 weights[3] = {seen.edge(1) * share, seen.edge(2) * share, seen.edge(0) * share};
    Opacity made{};
    made.thresholds = placed.thresholds;
    put(made.depth, weights[0] + weights[1] + weights[2]);
    const auto plane = [&](float (&to)[3], auto at) {
        put(to, weights[0] * double(at(corners[0])) + weights[1] * double(at(corners[1])) +
                    weights[2] * double(at(corners[2])));
    };
    made.by_vertices = !mesh.colours.empty();
    if (made.by_vertices) plane(made.vertices, [&](int k) { return mesh.colours[4 * k + 3]; });
    const Texture* texture = geom.texture < 0 ? nullptr : scene_.textures[geom.texture].get();
    if (!texture || !texture->has_opacity || texture->is_cube) return made;
    made.texture = texture, made.sizes = placed.sizes;
    for (int axis = 0; axis < 2; ++axis)
        plane(axis ? made.v : made.u, [&](int k) {
            return mesh.places[2 * k + axis] * geom.repeat[axis] + geom.offset;
        });
    return made;
}

// Where pixels from x on with these inverse depths are not below the cutoff, among those asked for.
iv Band::is_opaque(const Opacity& of, int x, int y, iv asked, fv nearest) const {
    const bool pinhole = lens_.pinhole;
    const fv inverse = 1.0f / (asked ? nearest : fv{} + 1.0f);
    const std::size_t row = pinhole ? 0 : std::size_t(y) * lens_.stride;
    struct Rays { fv x, y, z; };
    const auto rays = [&](std::size_t at) {
        return Rays{load<fv>(&lens_.x[at]), load<fv>(&lens_.y[at]), load<fv>(&lens_.z[at])};
    };
    const Rays here = pinhole ? Rays{load<fv>(&lens_.x[x]), fv{} + lens_.y[y], fv{} + 1.0f}
                              : rays(row + x);
    const auto times = [](const float(&plane)[3], const Rays& ray) {
        return ray.x * plane[0] + (ray.y * plane[1] + ray.z * plane[2]);
    };
    fv opacity = of.by_vertices ? times(of.vertices, here) * inverse : fv{} + 1.0f;
    fv least = fv{} + of.thresholds[0];
    if (!of.texture) return asked & (opacity >= least);
    const fv u = times(of.u, here) * inverse, v = times(of.v, here) * inverse;
    const auto step = [&](const Rays& ray) {  // how far a step moves, squared, texels
        const fv dq = times(of.depth, ray);
        const fv across = (times(of.u, ray) - u * dq) * inverse * float(of.texture->width());
        const fv down = (times(of.v, ray) - v * dq) * inverse * float(of.texture->height());
        return across * across + down * down;
    };
    Rays right{fv{} + float(lens_.step[0]), fv{}, fv{}}, below{fv{}, fv{} + float(lens_.step[1]), fv{}};
    if (!pinhole) {
        const auto less = [](Rays a, const Rays& b) { return Rays{a.x - b.x, a.y - b.y, a.z - b.z}; };
        right = less(rays(row + x + 1), here);
        below = less(rays(row + x + (y + 1 < lens_.height ? lens_.stride : 0)), here);
        iv columns{};
        for (int k = 0; k < lanes; ++k) columns[k] = x + k;
        const iv inner = columns < lens_.width - 1;
        right = {inner ? right.x : fv{}, inner ? right.y : fv{}, inner ? right.z : fv{}};
    }
    const fv one = step(right), other = step(below), most = one < other ? other : one;
    const fv within = most < 1e30f ? most : fv{} + 1e30f;
    iv level = (as_whole(128.0f * log_2(within)) - sharper + 128) >> 8;
    level = (most > 1.0f) & (level > 0) ? level : iv{};
    level = level < of.sizes - 1 ? level : iv{} + (of.sizes - 1);
    const fv across = Texture::within(u - floored(u)), down = Texture::within(v - floored(v));
    for (int k = 0; k < lanes; ++k) {
        if (!asked[k]) continue;
        opacity[k] *= of.texture->opacity(scene_.texels, across[k], down[k], level[k]);
        least[k] = of.thresholds[level[k]];
    }
    return asked & (opacity >= least);
}

Band::Opacity Band::opacity(const Triangle& triangle) const {
    const Placed& placed = scene_.placed_[triangle.geom];
    const std::int32_t* corners = placed.mesh->corners.data() + triangle.corner;
    return opacity(triangle, Corners({placed.seen[corners[0]], placed.seen[corners[1]],
                                      placed.seen[corners[2]]}));
}

void Band::shadow_cut(const Triangle& triangle) {
    const Opacity opacity = this->opacity(triangle);
    over(triangle, 0, [&](int y, int x, iv inside, fv q) {
        float* here = images_.depth + std::size_t(y) * lens_.width + x;
        const fv before = load<fv>(here), depth = 1.0f / q;
        const iv nearer = inside & (depth < before);
        if (any(nearer)) store(here, is_opaque(opacity, x, y, nearer, q) ? depth : before);
    });
}

void Band::cover_cut(const Triangle& triangle, std::int32_t number) {
    const bool rolling = view_.poses > 1;
    Opacity opacity{};
    if (!rolling) opacity = this->opacity(triangle);
    int row = -1;  // that it is known for, while all moves
    over(triangle, number, [&](int y, int x, iv inside, fv q) {
        float* nearest = nearest_ + at(y) + x;
        std::int32_t* visible = visible_ + at(y) + x;
        iv wins = inside & (q > load<fv>(nearest));
        if (!any(wins)) return;
        if (rolling && y != row)
            row = y, opacity = this->opacity(triangle, between_poses(number, y));
        wins = is_opaque(opacity, x, y, wins, q);
        store(nearest, wins ? q : load<fv>(nearest));
        store(visible, wins ? iv{} + number : load<iv>(visible));
    });
}

// Whether a pixel on an edge is the triangle's, and not that of the one beyond.
static bool owns(const Triangle& triangle, Vec3f ray) {
    const f4 at = triangle.planes(ray);
    for (int k = 0; k < 3; ++k) {
        const Vec3f edge = triangle.planes[k];
        if (at[k] == 0.0f && !(edge.x > 0 || (edge.x == 0 && edge.y > 0))) return false;
    }
    return true;
}

bool Band::owned(const Triangle& triangle, std::int32_t number, int x, int y) const {
    if (view_.poses == 1) return owns(triangle, lens_.ray(x, y));
    Triangle row = triangle;
    return seen(row, number, y) && owns(row, lens_.ray(x, y));
}

// Draw what is see-through over what is behind it, from the back to the front. It has a number, but
// no depth.
void Band::blend() {
    std::vector<float> front;  // inverse depth of the nearest of all
    for (std::size_t part = 0; part < scene_.clear_.size(); ++part) {
        std::int32_t number = clear_part | static_cast<std::int32_t>(part) << parts_from;
        for (const Triangle& triangle : scene_.clear_[part]) {
            const std::int32_t geom = scene_.placed_[triangle.geom].geom->number;
            if (front.empty()) front.assign(nearest_ + at(first_), nearest_ + at(last_) + widest);
            over(triangle, number, [&](int y, int x, iv inside, fv q) {
                const std::size_t here = at(y) + x;
                const iv wins = inside & (q > load<fv>(nearest_ + here));
                for (int k = 0; k < lanes && x + k < lens_.width; ++k) {
                    if (!wins[k] || !owned(triangle, number, x + k, y)) continue;
                    float& most = front[here - at(first_) + k];
                    if (q[k] > most) most = q[k], this->number(y, x + k, x + k + 1, geom);
                    if (images_.rgb) mix(x + k, y, q[k], number);
                }
            });
            ++number;
        }
    }
}

// Depth along the optical axis, metres; inf beyond the view's end.
void Band::measure() const {
    const float none = std::numeric_limits<float>::infinity(), far = view_.far;
    for (int y = first_; y < last_; ++y) {
        const float* from = nearest_ + at(y);
        float* to = images_.depth + std::size_t(y - view_.first) * lens_.width;
        if (lens_.pinhole) {
            for (int x = 0; x < lens_.width; ++x) {
                const float depth = from[x] > 0.0f ? 1.0f / from[x] : none;
                to[x] = depth > far ? none : depth;
            }
        } else {
            const float* ahead = &lens_.z[std::size_t(y) * lens_.stride];
            for (int x = 0; x < lens_.width; ++x) {
                const float depth = from[x] > 0.0f ? 1.0f / from[x] * ahead[x] : none;
                to[x] = ahead[x] > 0.0f && depth <= far ? depth : none;
            }
        }
    }
}

// Write the number of a geom, -1 for none, into pixels side by side.
void Band::number(int y, int left, int right, std::int32_t number) const {
    if (!images_.numbers) return;
    std::int32_t* to = images_.numbers + std::size_t(y - view_.first) * lens_.width;
    std::fill(to + left, to + right, number);
}

}  // namespace raster
