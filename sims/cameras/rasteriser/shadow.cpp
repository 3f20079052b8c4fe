// What moves, over a light's map of what stands still.
#include <algorithm>

#include "band.hpp"

namespace raster {

void Scene::shadow(const Lens& lens, float near, const Pose& eye, const Geom* geoms,
                   const Pose* poses, int count, const std::int32_t* moving, int moving_count,
                   const float* still, float* map, Box* covered) {
    const int size = lens.width;
    for (Box* box = covered; box < covered + count; ++box) {
        for (int y = box->top; y < box->bottom; ++y) {
            const std::size_t row = std::size_t(y) * size;
            std::copy(still + row + box->left, still + row + box->right, map + row + box->left);
        }
        *box = {};
    }
    lens_ = &lens;
    view_ = {};
    view_.width = view_.height = view_.last = size;
    view_.poses = view_.threads = 1;
    view_.near = near;
    first_ = 0, last_ = size;
    if (placed_.size() < std::size_t(count)) placed_.resize(count);
    Band band(*this, 0, size, {nullptr, map, nullptr});
    std::vector<Triangle> triangles;
    std::vector<Moving> none;
    for (const std::int32_t* index = moving; index < moving + moving_count; ++index) {
        Placed& placed = placed_[*index];
        place(geoms[*index], poses[*index], eye, placed);
        if (beyond(placed)) continue;
        placed.parts = 0;
        see(placed);
        triangles.clear();
        add(*index, triangles, none);
        if (triangles.empty()) continue;
        Box& box = covered[*index];
        box = {size, 0, size, 0};
        for (const Triangle& triangle : triangles) {
            box.left = std::min(box.left, triangle.left);
            box.right = std::max(box.right, triangle.right);
            box.top = std::min(box.top, triangle.top);
            box.bottom = std::max(box.bottom, triangle.bottom);
            band.shadow(triangle);
        }
    }
}

}  // namespace raster
