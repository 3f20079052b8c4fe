// What moves, over a light's map of what stands still.
#include <algorithm>
#include <cmath>

#include "band.hpp"

namespace raster {

namespace {

// Whether a triangle's image may hold the middle of a pixel; columns and rows of its corners, not a
// number of those that are too near.
//
// An edge is off by no more than 4e-4 pixels of a map of 1024², for rounding, and a corner by that
// over the sine of its angle. What is too thin to be told so is drawn.
inline bool holds_pixel(Lens::Pixel a, Lens::Pixel b, Lens::Pixel c) {
    constexpr double more = 0.05, least_sine = 0.02;
    const double left = std::min(std::min(a.column, b.column), c.column) - more;
    const double right = std::max(std::max(a.column, b.column), c.column) + more;
    const double top = std::min(std::min(a.row, b.row), c.row) - more;
    const double bottom = std::max(std::max(a.row, b.row), c.row) + more;
    if (std::floor(right) >= left && std::floor(bottom) >= top) return true;
    const double area = (b.column - a.column) * (c.row - a.row) -
                        (c.column - a.column) * (b.row - a.row);
    const double wide = right - left - 2 * more, high = bottom - top - 2 * more;
    return !(std::abs(area) >= least_sine * (wide * wide + high * high));
}

}  // namespace

void Scene::shadow(const Lens& lens, float near, const Pose& eye, const Geom* geoms,
                   const Pose* poses, int count, const std::int32_t* moving, int moving_count,
                   const float* still, float* map, std::uint32_t* changes, Box* covered) {
    const int size = lens.width;
    const auto touch = [&](const Box& box) {  // also tiles to whose right or below which it is
        if (box.left >= box.right) return;
        for (int y = std::max(box.top - 1, 0) / tile_side; y * tile_side < box.bottom; ++y)
            for (int x = std::max(box.left - 1, 0) / tile_side; x * tile_side < box.right; ++x)
                ++changes[y * tiles_across(size) + x];
    };
    for (Box* box = covered; box < covered + count; ++box) {
        for (int y = box->top; y < box->bottom; ++y) {
            const std::size_t row = std::size_t(y) * size;
            std::copy(still + row + box->left, still + row + box->right, map + row + box->left);
        }
        touch(*box);
        *box = {};
    }
    lens_ = &lens;
    view_ = {};
    view_.width = view_.height = view_.last = size;
    view_.poses = view_.threads = 1;
    view_.near = near;
    first_ = 0, last_ = size;
    if (placed_.size() < std::size_t(count)) placed_.resize(count);
    Memory none;
    Band band(*this, 0, size, {nullptr, map, nullptr}, none);
    const double per_step[2] = {1.0 / lens.step[0], 1.0 / lens.step[1]};
    std::vector<Lens::Pixel> at;
    for (const std::int32_t* index = moving; index < moving + moving_count; ++index) {
        Placed& placed = placed_[*index];
        place(geoms[*index], poses[*index], eye, placed);
        if (beyond(placed, placed.mesh->bounds)) continue;
        see(placed);
        at.clear();
        for (std::size_t k = 0; k < placed.seen.size(); ++k) {
            const double share = placed.seen[k].z >= near ? 1.0 : std::nan("");
            at.push_back({(placed.pixels[k].column - lens.x[0]) * per_step[0] * share,
                          (placed.pixels[k].row - lens.y[0]) * per_step[1] * share});
        }
        Box box{size, 0, size, 0};
        const Span<std::int32_t>& corners = placed.mesh->corners;
        for (std::size_t corner = 0; corner < corners.size(); corner += 3) {
            const std::int32_t* of = &corners[corner];
            if (!holds_pixel(at[of[0]], at[of[1]], at[of[2]])) continue;
            const Lens::Pixel rays[3] = {placed.pixels[of[0]], placed.pixels[of[1]],
                                         placed.pixels[of[2]]};
            const Vec3 points[3] = {placed.seen[of[0]], placed.seen[of[1]], placed.seen[of[2]]};
            const Corners from(points);
            if (!(from.away() < 0 || (from.away() > 0 && geoms[*index].double_sided))) continue;
            Triangle triangle;
            triangle.geom = *index, triangle.corner = static_cast<int>(corner);
            if (!bounded(triangle, points, rays, 3, false)) continue;
            triangle.planes = Planes(from);
            band.shadow(triangle);
            box.left = std::min(box.left, triangle.left);
            box.right = std::max(box.right, triangle.right);
            box.top = std::min(box.top, triangle.top);
            box.bottom = std::max(box.bottom, triangle.bottom);
        }
        if (box.left >= box.right) continue;
        touch(box);
        covered[*index] = box;
    }
}

}  // namespace raster
