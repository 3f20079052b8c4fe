// The frame's triangles: those of the geoms in view, in the optical frame, from front to back.
#include <algorithm>
#include <atomic>
#include <cmath>
#include <thread>

#include "band.hpp"

namespace raster {

// Do parts of some work, in as many threads as there may be.
void Scene::spread(int parts, const std::function<void(int)>& work) const {
    std::atomic<int> next{0};
    const auto run = [&] {
        for (int part; (part = next++) < parts;) work(part);
    };
    std::vector<std::thread> others;
    for (int k = 1; k < std::min(view_.threads, parts); ++k) others.emplace_back(run);
    run();
    for (std::thread& other : others) other.join();
}

void Scene::draw(const Lens& lens, const View& view, const Pose& eye, const Geom* geoms,
                 const Pose* poses, int count, const Light* lights, int light_count,
                 const Images& images) {
    lens_ = &lens;
    view_ = view;
    eye_ = eye;
    if (lights_.size() != std::size_t(light_count) ||
        (light_count && std::memcmp(lights_.data(), lights, sizeof(Light) * light_count))) {
        slots_.clear();
        lights_.assign(lights, lights + light_count);
    }
    slots_.resize(count);
    placed_.resize(count);
    std::vector<std::pair<double, int>> order;
    for (int index = 0; index < count; ++index) {
        Placed& placed = placed_[index];
        place(geoms[index], poses[index], placed);
        if (in_view(placed)) order.emplace_back(dot(placed.shift, placed.shift), index);
    }
    std::sort(order.begin(), order.end());  // front to back: of equal depths the first counts
    const int pieces = view.threads == 1 ? 1 : view.threads * 4;  // so that none waits long
    solid_.resize(pieces), clear_.resize(pieces);
    spread(pieces, [&](int part) {
        solid_[part].clear(), clear_[part].clear();
        const std::size_t first = order.size() * part / pieces;
        const std::size_t last = order.size() * (part + 1) / pieces;
        for (std::size_t k = first; k < last; ++k) {
            const int index = order[k].second;
            Placed& placed = placed_[index];
            placed.seen.resize(placed.mesh->points.size());
            for (std::size_t at = 0; at < placed.seen.size(); ++at) {
                const Vec3f p = placed.mesh->points[at];
                placed.seen[at] = placed.turn * Vec3{p.x, p.y, p.z} + placed.shift;
            }
            if (images.rgb) light(placed, poses[index], slots_[index]);
            if (geoms[index].rgba[3] >= 1.0f) add(solid_[part], index);
        }
        for (std::size_t k = last; k-- > first;)  // from back to front
            if (geoms[order[k].second].rgba[3] < 1.0f) add(clear_[part], order[k].second);
    });
    const int rows = view.last - view.first;
    nearest_.resize(std::size_t(rows) * lens.stride + widest);
    visible_.resize(std::size_t(rows) * lens.stride + widest);
    const int bands = std::min(pieces, rows);
    spread(bands, [&](int band) {
        const auto edge = [&](int number) {  // between the smallest squares of a lens
            if (number == 0 || number == bands) return number ? view.last : view.first;
            const int row = view.first + rows * number / bands;
            return std::max(row / Lens::smallest * Lens::smallest, view.first);
        };
        if (edge(band) < edge(band + 1)) Band(*this, edge(band), edge(band + 1), images).draw();
    });
}

void Scene::place(const Geom& geom, const Pose& pose, Placed& placed) const {
    placed.geom = &geom;
    placed.mesh = meshes[geom.mesh].get();
    placed.light = nullptr;
    placed.shift = eye_.turn.back({pose.position[0] - eye_.position[0],
                                   pose.position[1] - eye_.position[1],
                                   pose.position[2] - eye_.position[2]});
    for (int column = 0; column < 3; ++column) {
        const Vec3 axis = eye_.turn.back(
            {pose.turn.m[column], pose.turn.m[3 + column], pose.turn.m[6 + column]});
        placed.turn.m[column] = axis.x;
        placed.turn.m[3 + column] = axis.y;
        placed.turn.m[6 + column] = axis.z;
    }
}

bool Scene::in_view(Placed& placed) const {
    return lens_->pinhole ? in_frame(placed) : in_squares(placed);
}

// Whether the box about a geom may be in view: not beyond an edge of a pinhole's image.
bool Scene::in_frame(const Placed& placed) const {
    const Mesh& mesh = *placed.mesh;
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

// Direction of a ball from the eye and least cosine of rays that meet it, if the eye is outside.
bool Scene::ball(Vec3 middle, double reach, Vec3f& ahead, float& least) {
    const double away = dot(middle, middle), share = reach / away * 1.01;  // of squares
    if (!(share < 1.0)) {
        ahead = {}, least = -1;  // met by all
        return false;
    }
    ahead = narrow(middle * (1.0 / std::sqrt(away)));
    least = static_cast<float>(std::sqrt(1.0 - share)) - 1e-5f;
    return true;
}

// Whether the ball about a geom may be in view, and the smallest square of rays about it.
bool Scene::in_squares(Placed& placed) const {
    const Vec3 half{placed.mesh->reach.x, placed.mesh->reach.y, placed.mesh->reach.z};
    const Vec3 middle = placed.turn * Vec3{placed.mesh->middle.x, placed.mesh->middle.y,
                                           placed.mesh->middle.z} + placed.shift;
    placed.square = 0, placed.column = placed.row = 0, placed.side = lens_->largest;
    Vec3f ahead;
    float least;
    if (!ball(middle, dot(half, half), ahead, least)) return true;
    for (;;) {
        const Lens::Square& square = lens_->squares[placed.square];
        const f4 most = (ahead.x > 0 ? square.high : square.low)[0] * ahead.x +
                        ((ahead.y > 0 ? square.high : square.low)[1] * ahead.y +
                         (ahead.z > 0 ? square.high : square.low)[2] * ahead.z);
        const i4 met = (most >= least) & (square.low[2] <= square.high[2]);
        const int found = bits(met);
        if (!found) return false;
        const int part = __builtin_ctz(found);
        if (found & (found - 1) || square.parts[part] < 0) return true;
        placed.square = square.parts[part], placed.side /= 2;
        placed.column += part % 2 * placed.side, placed.row += part / 2 * placed.side;
    }
}

// Add a geom's triangles to the frame, unless they are out of view.
void Scene::add(std::vector<Triangle>& to, int index) const {
    const Placed& placed = placed_[index];
    const std::vector<std::int32_t>& corners = placed.mesh->corners;
    for (std::size_t corner = 0; corner < corners.size(); corner += 3) {
        const Vec3 points[3] = {placed.seen[corners[corner]], placed.seen[corners[corner + 1]],
                                placed.seen[corners[corner + 2]]};
        const double away = dot(cross(points[1] - points[0], points[2] - points[0]), points[0]);
        if (away == 0 || (away > 0 && placed.geom->culled)) continue;
        Triangle triangle;
        if (!bounded(triangle, points)) continue;
        triangle.geom = index;
        triangle.corner = static_cast<int>(corner);
        triangle.see(Corners(points));
        to.push_back(triangle);
    }
}

// Find the pixels about a triangle's image; false if there are none.
bool Scene::bounded(Triangle& triangle, const Vec3 (&points)[3]) const {
    triangle.left = 0, triangle.right = lens_->width;
    triangle.top = view_.first, triangle.bottom = view_.last;
    if (!lens_->pinhole) {
        const Vec3 middle = (points[0] + points[1] + points[2]) * (1.0 / 3);
        double reach = 0;
        for (const Vec3& point : points) reach = std::max(reach, dot(point - middle, point - middle));
        ball(middle, reach, triangle.ahead, triangle.least);
        return true;
    }
    double low[2] = {1e30, 1e30}, high[2] = {-1e30, -1e30};
    const double near = view_.near;
    const auto see = [&](Vec3 p) {
        const double share = 1.0 / p.z, x = p.x * share, y = p.y * share;
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
    const auto span = [](double low, double high, double start, double step, int& first, int& last) {
        const double from = (low - start) / step - 1.0, to = (high - start) / step + 2.0;
        if (!(to > first) || !(from < last)) return false;
        first = from > first ? static_cast<int>(from) : first;
        last = to < last ? static_cast<int>(to) : last;
        return first < last;
    };
    return span(low[0], high[0], lens_->x[0], lens_->step[0], triangle.left, triangle.right) &&
           span(low[1], high[1], lens_->y[0], lens_->step[1], triangle.top, triangle.bottom);
}

}  // namespace raster
