// The pixels that a triangle covers.
#pragma once

#include <algorithm>
#include <limits>

#include "scene.hpp"

namespace raster {

// Call found(y, x, inside, inverse depth) for blocks of pixels that a triangle may cover.
template <bool pinhole, typename Found>
void Scene::scan(const Triangle& triangle, Found found) const {
    const f8 nearest = f8{} + 1.0f / view_.near;
    const float(&e)[3][3] = triangle.edges;
    const float(&d)[3] = triangle.depth;
    for (int y = triangle.top; y < triangle.bottom; ++y) {
        if constexpr (pinhole) {
            const float down = lens_->y[y];
            float at[4];
            for (int k = 0; k < 3; ++k) at[k] = e[k][1] * down + e[k][2];
            at[3] = d[1] * down + d[2];
            // The columns between the edges: a block more on each side for rounding.
            float low = lens_->x[triangle.left], high = lens_->x[triangle.right - 1];
            for (int k = 0; k < 3; ++k) {
                if (e[k][0] > 0)
                    low = std::max(low, -at[k] / e[k][0]);
                else if (e[k][0] < 0)
                    high = std::min(high, -at[k] / e[k][0]);
                else if (at[k] < 0)
                    high = -std::numeric_limits<float>::max();
            }
            const float step = lens_->width > 1 ? lens_->x[1] - lens_->x[0] : 1.0f;
            if (!(low <= high + 4 * step)) continue;
            const float begin = (low - lens_->x[0]) / step - 2, end = (high - lens_->x[0]) / step + 3;
            int from = begin > triangle.left ? static_cast<int>(begin) : triangle.left;
            const int to = end < triangle.right ? static_cast<int>(end) : triangle.right;
            for (from &= ~(lanes - 1); from < to; from += lanes) {
                const f8 x = load(&lens_->x[from]);
                const f8 q = x * d[0] + at[3];
                const i8 inside = (x * e[0][0] + at[0] >= 0.0f) & (x * e[1][0] + at[1] >= 0.0f) &
                                  (x * e[2][0] + at[2] >= 0.0f) & (q > 0.0f) & (q <= nearest);
                found(y, from, inside, q);
            }
        } else {
            const std::size_t row = std::size_t(y) * lens_->stride;
            for (int from = triangle.left & ~(lanes - 1); from < triangle.right; from += lanes) {
                const f8 rx = load(&lens_->x[row + from]), ry = load(&lens_->y[row + from]);
                const f8 rz = load(&lens_->z[row + from]);
                const auto times = [&](const float(&p)[3]) {
                    return rx * p[0] + (ry * p[1] + rz * p[2]);
                };
                const f8 q = times(d);
                const i8 inside = (times(e[0]) >= 0.0f) & (times(e[1]) >= 0.0f) &
                                  (times(e[2]) >= 0.0f) & (q > 0.0f) & (q <= nearest);
                found(y, from, inside, q);
            }
        }
    }
}

// Whether none of some rays can meet a triangle: all are beyond an edge, or behind.
static bool misses(const Triangle& triangle, const Lens::Box& box) {
    if (!(box.low[2] <= box.high[2])) return true;  // no rays
    const auto beyond = [&](const float(&plane)[3]) {
        float most = 0;
        for (int i = 0; i < 3; ++i) most += plane[i] * (plane[i] > 0 ? box.high[i] : box.low[i]);
        return most < 0;
    };
    return beyond(triangle.edges[0]) || beyond(triangle.edges[1]) || beyond(triangle.edges[2]) ||
           beyond(triangle.depth);
}

// Call `found` as `scan` does, for a triangle of the frame.
template <typename Found>
void Scene::over(const Triangle& triangle, Found found) const {
    if (lens_->pinhole) return scan<true>(triangle, found);
    const auto inside = [&](const Lens::Grid& grid, const Triangle& within, auto visit) {
        for (int row = within.top / grid.side; row * grid.side < within.bottom; ++row)
            for (int column = within.left / grid.side; column * grid.side < within.right; ++column) {
                if (misses(triangle, grid.boxes[std::size_t(row) * grid.across + column])) continue;
                Triangle part = triangle;
                part.left = column * grid.side;
                part.right = std::min(part.left + grid.side, lens_->width);
                part.top = std::max(row * grid.side, within.top);
                part.bottom = std::min((row + 1) * grid.side, within.bottom);
                visit(part);
            }
    };
    inside(lens_->coarse, triangle, [&](const Triangle& large) {
        inside(lens_->fine, large, [&](const Triangle& small) { scan<false>(small, found); });
    });
}

}  // namespace raster
