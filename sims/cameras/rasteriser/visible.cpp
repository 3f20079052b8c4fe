// Which triangle each pixel sees: the geoms' triangles in the optical frame, and the nearest of them.
#include <algorithm>
#include <cmath>
#include <limits>

#include "scan.hpp"

namespace raster {

void Scene::draw(const Lens& lens, const View& view, const Geom* geoms, int count,
                 const Light* lights, int light_count, std::uint8_t* rgb, float* depth,
                 std::int32_t* numbers) {
    lens_ = &lens;
    view_ = view;
    lights_.assign(lights, lights + light_count);
    if (lights_.size() != slots_lights_.size() ||
        std::memcmp(lights_.data(), slots_lights_.data(), sizeof(Light) * lights_.size())) {
        slots_.clear();
        slots_lights_ = lights_;
    }
    slots_.resize(count);
    triangles_.clear();
    surfaces_.clear();
    blended_.clear();
    const int rows = view.last - view.first;
    nearest_.assign(std::size_t(rows) * lens.stride + lanes, 0.0f);
    visible_.assign(std::size_t(rows) * lens.stride, -1);
    if (placed_.size() < std::size_t(count)) placed_.resize(count);
    std::vector<std::pair<double, int>> order;
    for (int index = 0; index < count; ++index) {
        place(geoms[index], index);
        if (!in_view(placed_[index], *meshes[geoms[index].mesh])) continue;
        const Vec3 shift = placed_[index].shift;
        order.emplace_back(dot(shift, shift), index);
    }
    std::sort(order.begin(), order.end());  // front to back: of equal depths the first counts
    for (const auto& [_, index] : order) {
        Placed& placed = placed_[index];
        const Mesh& mesh = *meshes[placed.geom.mesh];
        placed.seen.resize(mesh.points.size());
        for (std::size_t k = 0; k < mesh.points.size(); ++k) {
            const Vec3f p = mesh.points[k];
            placed.seen[k] = placed.turn * Vec3{p.x, p.y, p.z} + placed.shift;
        }
    }
    for (const auto& [_, index] : order)
        if (placed_[index].geom.rgba[3] >= 1.0f)
            for (std::size_t k = 0; k < meshes[placed_[index].geom.mesh]->corners.size(); k += 3)
                add(index, static_cast<int>(k), false);
    if (rgb) surface_of_.assign(triangles_.size(), -1), shade(rgb);
    for (auto at = order.rbegin(); at != order.rend(); ++at)  // back to front
        if (const Geom& geom = placed_[at->second].geom; geom.rgba[3] < 1.0f)
            for (std::size_t k = 0; k < meshes[geom.mesh]->corners.size(); k += 3)
                add(at->second, static_cast<int>(k), true);
    if (rgb) surface_of_.resize(triangles_.size(), -1);
    blend(rgb);
    if (depth) measure(depth);
    if (numbers) number(numbers);
}

// Depth along the optical axis, metres; inf beyond the view's end.
void Scene::measure(float* depth) const {
    const float none = std::numeric_limits<float>::infinity();
    for (int y = view_.first; y < view_.last; ++y) {
        const float* from = nearest_.data() + std::size_t(y - view_.first) * lens_->stride;
        float* to = depth + std::size_t(y - view_.first) * lens_->width;
        for (int x = 0; x < lens_->width; ++x) to[x] = 1.0f / from[x];
        if (!lens_->pinhole)
            for (int x = 0; x < lens_->width; ++x) {
                const float ahead = ray(x, y).z;
                to[x] = ahead > 0.0f ? to[x] * ahead : none;
            }
        for (int x = 0; x < lens_->width; ++x) to[x] = to[x] > view_.far ? none : to[x];
    }
}

// Number of each pixel's geom; -1 for none.
void Scene::number(std::int32_t* numbers) const {
    for (int y = 0; y < view_.last - view_.first; ++y)
        for (int x = 0; x < lens_->width; ++x) {
            const std::int32_t seen = visible_[std::size_t(y) * lens_->stride + x];
            *numbers++ = seen < 0 ? -1 : placed_[triangles_[seen].geom].geom.number;
        }
}

void Scene::place(const Geom& geom, int index) {
    Placed& placed = placed_[index];
    placed.geom = geom;
    placed.light = nullptr;
    const Vec3 apart{geom.position[0] - view_.position[0], geom.position[1] - view_.position[1],
                     geom.position[2] - view_.position[2]};
    placed.shift = view_.turn.back(apart);
    for (int column = 0; column < 3; ++column) {
        const Vec3 axis = view_.turn.back(
            {geom.turn.m[column], geom.turn.m[3 + column], geom.turn.m[6 + column]});
        placed.turn.m[column] = axis.x;
        placed.turn.m[3 + column] = axis.y;
        placed.turn.m[6 + column] = axis.z;
    }
}

// Whether the box about a geom may be in view: not beyond an edge of a pinhole's image.
bool Scene::in_view(const Placed& placed, const Mesh& mesh) const {
    if (!lens_->pinhole) return true;
    const float left = lens_->x[0], right = lens_->x[lens_->width - 1];
    const float top = lens_->y[view_.first], bottom = lens_->y[view_.last - 1];
    const Vec3 middle =
        placed.turn * Vec3{mesh.middle.x, mesh.middle.y, mesh.middle.z} + placed.shift;
    const Vec3 inward[5] = {{1, 0, -left}, {-1, 0, right}, {0, 1, -top}, {0, -1, bottom}, {0, 0, 1}};
    for (const Vec3& normal : inward) {
        const Vec3 along = placed.turn.back(normal);
        const double reach = std::abs(along.x) * mesh.reach.x + std::abs(along.y) * mesh.reach.y +
                             std::abs(along.z) * mesh.reach.z;
        if (dot(normal, middle) + reach * 1.001 < 0) return false;
    }
    return true;
}

// Add a triangle to the frame, unless it is out of view, and what it covers to the pixels.
void Scene::add(int geom, int corner, bool blended) {
    const Placed& placed = placed_[geom];
    const std::int32_t* corners = meshes[placed.geom.mesh]->corners.data() + corner;
    const Vec3 points[3] = {placed.seen[corners[0]], placed.seen[corners[1]],
                            placed.seen[corners[2]]};
    const Vec3 normal = cross(points[1] - points[0], points[2] - points[0]);
    const double away = dot(normal, points[0]);
    if (away == 0 || (away > 0 && placed.geom.culled)) return;
    Triangle triangle;
    triangle.geom = geom;
    triangle.corner = corner;
    if (!bounded(triangle, points)) return;
    const double share = 1.0 / away, side = away > 0 ? 1.0 : -1.0;
    const auto put = [](float (&to)[3], Vec3 from) {
        to[0] = static_cast<float>(from.x);
        to[1] = static_cast<float>(from.y);
        to[2] = static_cast<float>(from.z);
    };
    put(triangle.depth, normal * share);
    for (int k = 0; k < 3; ++k)
        put(triangle.edges[k], cross(points[k], points[(k + 1) % 3]) * side);
    const auto number = static_cast<std::int32_t>(triangles_.size());
    triangles_.push_back(triangle);
    if (blended)
        blended_.push_back(number);
    else
        cover(triangle, number);
}

// Find the pixels about a triangle's image; false if there are none.
bool Scene::bounded(Triangle& triangle, const Vec3 (&points)[3]) const {
    triangle.left = 0, triangle.right = lens_->width;
    triangle.top = view_.first, triangle.bottom = view_.last;
    if (!lens_->pinhole) return true;
    double low[2] = {1e30, 1e30}, high[2] = {-1e30, -1e30};
    const double near = view_.near;
    const auto see = [&](Vec3 p) {
        const double x = p.x / p.z, y = p.y / p.z;
        low[0] = std::min(low[0], x), high[0] = std::max(high[0], x);
        low[1] = std::min(low[1], y), high[1] = std::max(high[1], y);
    };
    for (int k = 0; k < 3; ++k) {
        const Vec3 from = points[k], to = points[(k + 1) % 3];
        if (from.z >= near) see(from);
        if ((from.z >= near) != (to.z >= near)) {
            Vec3 at = from + (to - from) * ((near - from.z) / (to.z - from.z));
            at.z = near;
            see(at);
        }
    }
    // Columns are at equal steps of x, rows of y; a pixel more on each side for rounding.
    const auto span = [](double low, double high, const std::vector<float>& at, int count,
                         int& first, int& last) {
        const double step = count > 1 ? (double(at[count - 1]) - at[0]) / (count - 1) : 1.0;
        const double from = (low - at[0]) / step - 1.0, to = (high - at[0]) / step + 2.0;
        if (!(to > first) || !(from < last)) return false;
        first = from > first ? static_cast<int>(from) : first;
        last = to < last ? static_cast<int>(to) : last;
        return first < last;
    };
    return span(low[0], high[0], lens_->x, lens_->width, triangle.left, triangle.right) &&
           span(low[1], high[1], lens_->y, lens_->height, triangle.top, triangle.bottom);
}

void Scene::cover(const Triangle& triangle, std::int32_t number) {
    const i8 mine = i8{} + number;
    over(triangle, [&](int y, int x, i8 inside, f8 q) __attribute__((always_inline)) {
        const std::size_t at = std::size_t(y - view_.first) * lens_->stride + x;
        const f8 before = load(&nearest_[at]);
        const i8 wins = inside & (q > before);
        store(&nearest_[at], wins ? q : before);
        store(&visible_[at], wins ? mine : load(&visible_[at]));
    });
}

}  // namespace raster
