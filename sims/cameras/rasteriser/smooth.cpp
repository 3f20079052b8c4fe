// Smooth outlines: a pixel that an outline crosses shows both sides, as a sensor's pixel gathers.
//
// Visibility knows a pixel's middle only. Where two neighbours see different parts (sides of a box,
// surfaces of a mesh without a crease), the plane that parts them (an edge of the nearer, or where
// two surfaces meet) says where between the middles it runs, and so how much of a pixel is the
// other's (E. Persson, "Geometric Post-process Anti-aliasing", 2011). Textures stay as they are.
#include <algorithm>
#include <array>
#include <cmath>
#include <numeric>
#include <tuple>

#include "band.hpp"

namespace raster {

// Join triangles that share a vertex: there the normal is the same, which a crease parts. And find
// those on the other side of each edge.
int Mesh::find_parts(std::int32_t* to_parts, std::int32_t* to_beyond) const {
    std::vector<std::int32_t> root(points.size()), same(points.size());
    std::iota(root.begin(), root.end(), 0), std::iota(same.begin(), same.end(), 0);
    std::vector<std::array<std::int64_t, 6>> places;  // rounded: a turn ends where it began
    const auto whole = [](float x) {
        return std::int64_t(std::llrint(std::min(9e18f, std::max(-9e18f, x))));
    };
    for (std::size_t k = 0; k < points.size(); ++k) {
        const Vec3f p = points[k] * 1e5f, n = normals[k] * 1e3f;
        places.push_back({whole(p.x), whole(p.y), whole(p.z), whole(n.x), whole(n.y), whole(n.z)});
    }
    const auto less = [&](std::int32_t a, std::int32_t b) { return places[a] < places[b]; };
    const auto find = [&](std::int32_t at) {
        while (root[at] != at) at = root[at] = root[root[at]];
        return at;
    };
    std::sort(same.begin(), same.end(), less);  // vertices that only the places in a texture part
    std::vector<std::int32_t> first(points.size());  // of the vertices that are the same
    for (std::size_t k = 0; k < same.size(); ++k) {
        const bool equal = k && !less(same[k - 1], same[k]);
        first[same[k]] = equal ? first[same[k - 1]] : same[k];
        root[find(same[k])] = find(first[same[k]]);
    }
    for (std::size_t k = 0; k < corners.size(); ++k)
        root[find(corners[k])] = find(corners[k / 3 * 3]);
    struct Side {
        std::int32_t low, high, side;  // ends, and its number among all triangles' sides
    };
    std::vector<Side> sides;
    for (std::int32_t k = 0; k < static_cast<std::int32_t>(corners.size()); k += 3) {
        const std::int32_t a = first[corners[k]], b = first[corners[k + 1]];
        const std::int32_t c = first[corners[k + 2]];
        if (a == b || b == c || c == a) continue;  // at the pole of a ball
        sides.push_back({std::min(a, b), std::max(a, b), k});
        sides.push_back({std::min(b, c), std::max(b, c), k + 1});
        sides.push_back({std::min(c, a), std::max(c, a), k + 2});
    }
    std::sort(sides.begin(), sides.end(), [](const Side& a, const Side& b) {
        return std::tie(a.low, a.high, a.side) < std::tie(b.low, b.high, b.side);
    });
    std::fill(to_beyond, to_beyond + corners.size(), -1);
    for (std::size_t k = 1; k < sides.size(); ++k) {
        const Side &one = sides[k - 1], &other = sides[k];
        if (one.low != other.low || one.high != other.high) continue;
        to_beyond[one.side] = other.side / 3 * 3, to_beyond[other.side] = one.side / 3 * 3;
    }
    std::vector<std::int32_t> number(points.size(), -1);
    int count = 0;
    for (std::size_t k = 0; k < corners.size(); k += 3) {
        std::int32_t& part = number[find(corners[k])];
        if (part < 0) part = count++;
        *to_parts++ = part;
    }
    return count;
}

// The triangle that a row's pixel sees, while all moves as the row sees it; null for none.
const Triangle* Band::seen_by(std::int32_t number, int y, Triangle& row) const {
    if (number < 0) return nullptr;
    if (view_.poses == 1) return &triangle(number);
    if (y >= scene_.first_) return seen(row = triangle(number), number, y) ? &row : nullptr;
    const Moving& moving = scene_.before_moving_[number];
    row = scene_.before_[number];  // it is above these rows
    const Corners corners(moving.from, moving.to, share(y) + scene_.passed_);
    row.planes = Planes(corners), row.behind = corners.away() > 0;
    return &row;
}

// Where between two rays a surface without a crease ends, of which the first ray meets a triangle.
Band::End Band::end(const Triangle& triangle, Vec3f from, Vec3f to, int y) const {
    const Placed& placed = scene_.placed_[triangle.geom];
    const Mesh& mesh = *placed.mesh;
    const auto point = [&](std::int32_t corner) {
        const Vec3 now = placed.seen[corner];
        if (view_.poses == 1) return now;
        const Vec3 later = scene_.later_[triangle.geom].seen[corner];
        return now + (later - now) * share(y);
    };
    std::int32_t corner = triangle.corner;
    Planes at = triangle.planes;
    End found{2, {}};
    for (int count = 0; count < most_triangles; ++count) {  // across the edges between two of them
        const f4 here = at(from), there = at(to);
        float share = 2;
        int edge = 0;
        for (int k = 0; k < 3; ++k) {
            if (!(there[k] < 0 && there[k] < here[k])) continue;
            const float leaves = here[k] > 0 ? here[k] / (here[k] - there[k]) : 0;
            if (leaves < share) share = leaves, edge = k;
        }
        if (share > 1) return {2, {}};
        found = {count ? std::max(share, found.share) : share, at[edge]};
        corner = mesh.beyond[corner + edge];
        if (corner < 0) return found;
        if (view_.poses == 1) {
            const std::int32_t number = placed.listed[corner / 3];
            if (number == Placed::faces_away) return found;
            if (number >= 0) {
                const Triangle& next = (*placed.list)[number];
                if (next.behind != triangle.behind) return found;
                at = next.planes;
                continue;
            }
        }
        const std::int32_t* corners = mesh.corners.data() + corner;
        const Vec3 next[3] = {point(corners[0]), point(corners[1]), point(corners[2])};
        const double away = dot(cross(next[1] - next[0], next[2] - next[0]), next[0]);
        if (!(triangle.behind ? away > 0 : away < 0)) return found;
        at = Planes(Corners(next));
    }
    return found;
}

// Blend two neighbours that see different parts: a pixel and the one right of it, or below it.
void Band::smooth(int x, int y, bool below) {
    const int other_x = x + !below, other_y = y + below;
    const std::size_t here = at(y) + x, there = at(other_y) + other_x;
    Triangle rows[2];  // while all moves
    const Triangle* first = seen_by(visible_[here], y, rows[0]);
    const Triangle* second = seen_by(visible_[there], other_y, rows[1]);
    const bool turned = !first || (second && nearest_[there] > nearest_[here]);
    if (turned) std::swap(first, second);  // the first is the nearer one
    if (!first) return;
    const Vec3f near_ray = turned ? lens_.ray(other_x, other_y) : lens_.ray(x, y);
    const Vec3f far_ray = turned ? lens_.ray(x, y) : lens_.ray(other_x, other_y);
    const Planes& nearer = first->planes;
    const f4 mine = nearer(near_ray), beyond = nearer(far_ray);
    // Of the way between the middles that is the nearer one's, and what ends it.
    auto [share, plane] = end(*first, near_ray, far_ray, y);
    if (share > 1) {
        if (!second || scene_.placed_[first->geom].thresholds) return;  // it ends by its opacity
        const Planes& farther = second->planes;
        const f4 theirs = farther(far_ray), behind = farther(near_ray);
        const End start = end(*second, far_ray, near_ray, y);
        share = 1 - start.share, plane = start.plane;
        if (start.share > 1) {  // they meet
            const float inside = mine[3] - behind[3], outside = beyond[3] - theirs[3];
            if (!(inside >= 0 && outside < 0)) return;
            share = inside / (inside - outside);
            if (!(share >= 0)) return;  // too large to tell
            plane = nearer[3] - farther[3];
        }
    }
    // An outline is measured along the direction that crosses it more steeply.
    const int aside_x = below ? (x + 1 < lens_.width ? x + 1 : x - 1) : x;
    const int aside_y = below ? y : (y + 1 < lens_.height ? y + 1 : y - 1);
    if (aside_x < 0 || aside_y < 0) return;
    const float steep = std::abs(dot(plane, far_ray - near_ray));
    const float flat = std::abs(dot(plane, lens_.ray(aside_x, aside_y) - lens_.ray(x, y)));
    if (below ? steep <= flat : steep < flat) return;
    const int parts = static_cast<int>(256.0f * share);
    if (parts == 128) return;
    const bool upon_near = parts < 128;  // the far one covers a part of the nearer one's pixel
    const bool to_other = upon_near == turned;
    const int to_x = to_other ? other_x : x, to_y = to_other ? other_y : y;
    if (to_y >= last_ || (to_y < first_ && first_ > scene_.first_)) return;  // another band's
    const std::uint8_t* colour = to_other ? row(y) + 3 * x : row(other_y) + 3 * other_x;
    outlines_.push_back({row(to_y) + 3 * to_x, {colour[0], colour[1], colour[2]},
                         std::abs(parts - 128)});
}

// Find the pixels that outlines cross between a row and the one above it, which see these parts.
void Band::find_below(int y, const std::int32_t* above, const std::int32_t* parts) {
    for (int x = 0; x < lens_.width; x += lanes) {
        const iv differs = load<iv>(parts + x) != load<iv>(above + x);
        for (int found = bits(differs); found; found &= found - 1) {
            const int column = x + __builtin_ctz(found);
            if (column < lens_.width) smooth(column, y - 1, true);
        }
    }
}

// Find the pixels that outlines cross between these rows and those of other bands, once all are
// shaded.
void Band::find_outlines() {
    std::vector<std::int32_t> rows[2];
    for (auto& row : rows) row.resize(lens_.stride + lanes);
    for (const int y : {first_, last_}) {
        if (y == view_.first || y == scene_.last_) continue;
        for (int k = 0; k < 2; ++k)
            runs(y - 1 + k, [&](int left, int right, std::int32_t number) {
                Triangle row;
                const Triangle* triangle =
                    number < 0 ? nullptr : y - 1 + k < scene_.first_ ? seen_by(number, y - 1 + k, row)
                                                                     : &this->triangle(number);
                std::fill(&rows[k][left], &rows[k][right], triangle ? triangle->part : -1);
            });
        const std::ptrdiff_t before = outlines_.size();
        find_below(y, rows[0].data(), rows[1].data());
        if (y == first_)  // a pixel's neighbours are blended in the same order in any band
            std::rotate(outlines_.begin() + first_row_, outlines_.begin() + before, outlines_.end());
    }
}

// Blend them. Light is added, of which grey levels are roughly the square root.
void Band::smooth_outlines() const {
    for (const Outline& each : outlines_) {
        float levels[4] = {};
        for (int k = 0; k < 3; ++k) {
            const int mine = each.pixel[k], other = each.colour[k];
            levels[k] = static_cast<float>(mine * mine * (256 - each.share) +
                                           other * other * each.share) * (1.0f / 256);
        }
        for (float& level : levels) level = std::sqrt(level) + 0.5f;
        for (int k = 0; k < 3; ++k) each.pixel[k] = static_cast<std::uint8_t>(levels[k]);
    }
}

}  // namespace raster
