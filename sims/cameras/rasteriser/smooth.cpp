// Smooth outlines: a pixel that an outline crosses shows both sides, as a sensor's pixel gathers.
//
// Visibility knows a pixel's middle only. Where two neighbours see different parts (sides of a box,
// surfaces of a mesh without a crease), the plane that parts them (an edge of the nearer, or where
// two surfaces meet) says where between the middles it runs, and so how much of a pixel is the
// other's (E. Persson, "Geometric Post-process Anti-aliasing", 2011). Textures stay as they are.
#include <algorithm>
#include <cmath>
#include <numeric>

#include "band.hpp"

namespace raster {

namespace {

// What a triangle's planes say of a ray: three edges, positive inside, and the inverse depth.
struct Planes {
    f4 x, y, z;

    explicit Planes(const Triangle& of)
        : x{of.edges[0][0], of.edges[1][0], of.edges[2][0], of.depth[0]},
          y{of.edges[0][1], of.edges[1][1], of.edges[2][1], of.depth[1]},
          z{of.edges[0][2], of.edges[1][2], of.edges[2][2], of.depth[2]} {}

    f4 operator()(Vec3f ray) const { return x * ray.x + (y * ray.y + z * ray.z); }
    Vec3f operator[](int k) const { return {x[k], y[k], z[k]}; }
};

// Where between two rays, 0 to 1, a triangle ends that the first of them meets, and by which edge.
struct End {
    float share = 2;  // the second meets it, too
    int edge = 0;

    End(f4 inside, f4 outside) {
        inside = inside > 0.0f ? inside : f4{};
        const f4 shares = inside / (inside - outside);
        const i4 ends = outside < 0.0f;
        for (int k = 0; k < 3; ++k)
            if (ends[k] && shares[k] < share) share = shares[k], edge = k;
    }
};

}  // namespace

// Join triangles that share a vertex: there the normal is the same, which a crease parts.
void Mesh::find_parts() {
    std::vector<std::int32_t> root(points.size()), same(points.size());
    std::iota(root.begin(), root.end(), 0), std::iota(same.begin(), same.end(), 0);
    const auto less = [&](std::int32_t a, std::int32_t b) {
        const int order = std::memcmp(&points[a], &points[b], sizeof points[a]);
        return order ? order < 0 : std::memcmp(&normals[a], &normals[b], sizeof normals[a]) < 0;
    };
    const auto find = [&](std::int32_t at) {
        while (root[at] != at) at = root[at] = root[root[at]];
        return at;
    };
    std::sort(same.begin(), same.end(), less);  // vertices that only the places in a texture part
    for (std::size_t k = 1; k < same.size(); ++k)
        if (!less(same[k - 1], same[k])) root[find(same[k])] = find(same[k - 1]);
    for (std::size_t k = 0; k < corners.size(); ++k)
        root[find(corners[k])] = find(corners[k / 3 * 3]);
    std::vector<std::int32_t> number(points.size(), -1);
    for (std::size_t k = 0; k < corners.size(); k += 3) {
        std::int32_t& part = number[find(corners[k])];
        if (part < 0) part = part_count++;
        parts.push_back(part);
    }
}

// The triangle that a row's pixel sees, while all moves as the row sees it; null for none.
const Triangle* Band::seen_by(std::int32_t number, int y, Triangle& row) const {
    if (number < 0) return nullptr;
    if (view_.poses == 1) return &triangle(number);
    if (y >= scene_.first_) return seen(row = triangle(number), number, y) ? &row : nullptr;
    // A row of the rows before these. What was see-through there counts as nothing.
    if (std::size_t(number) >= scene_.before_.size()) return nullptr;
    const Moving& moving = scene_.before_moving_[number];
    row = scene_.before_[number];
    row.see({moving.from, moving.to, (y - scene_.start_) / scene_.step_ + 1});
    return &row;
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
    const Planes nearer(*first);
    const f4 mine = nearer(near_ray), beyond = nearer(far_ray);
    const End end(mine, beyond);
    Vec3f plane = nearer[end.edge];
    float share = end.share;  // of the way between the middles that is the nearer one's
    if (share > 1) {
        if (!second) return;
        const Planes farther(*second);
        const f4 theirs = farther(far_ray), behind = farther(near_ray);
        const End start(theirs, behind);
        share = 1 - start.share, plane = farther[start.edge];
        if (start.share > 1) {  // they meet
            const float inside = mine[3] - behind[3], outside = beyond[3] - theirs[3];
            if (!(inside >= 0 && outside < 0)) return;
            share = inside / (inside - outside);
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

// Find the pixels that outlines cross, once all rows are shaded.
void Band::find_outlines() {
    outlines_.clear();
    std::vector<std::int32_t> rows[2];  // parts that each pixel of a row, and of that above, sees
    for (auto& row : rows) row.resize(lens_.stride + lanes);
    const int top = std::max(first_ - 1, view_.first), end = std::min(last_ + 1, scene_.last_);
    for (int y = top; y < end; ++y) {
        std::int32_t* parts = rows[y & 1].data();
        const std::int32_t* above = rows[~y & 1].data();
        const bool mine = y >= first_ && y < last_;
        runs(y, [&](int left, int right, std::int32_t number) {
            Triangle row;
            const Triangle* triangle = y < scene_.first_ ? seen_by(number, y, row) :
                                       number < 0 ? nullptr : &this->triangle(number);
            const std::int32_t part = triangle ? triangle->part : -1;
            std::fill(parts + left, parts + right, part);
            if (mine && left && part != parts[left - 1]) smooth(left - 1, y, false);
        });
        if (y == top) continue;
        for (int x = 0; x < lens_.width; x += lanes) {
            const iv differs = load<iv>(parts + x) != load<iv>(above + x);
            for (int found = bits(differs); found; found &= found - 1) {
                const int column = x + __builtin_ctz(found);
                if (column < lens_.width) smooth(column, y - 1, true);
            }
        }
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
