// The frame's triangles: those of the geoms in view, in the optical frame, from front to back.
#include <algorithm>
#include <atomic>
#include <cmath>
#include <thread>

#include "band.hpp"

namespace raster {

constexpr std::size_t smallest_batch = 8000;  // triangles

void Mesh::find_clusters(Cluster* to) const {
    const int count = static_cast<int>(corners.size()) / 3;
    for (int first = 0; cluster_count(count) && first < count; first += Cluster::most) {
        const int last = std::min(first + Cluster::most, count);
        const auto point = [&](int k) { return points[corners[k]]; };
        const auto widened = [&](int k) { const Vec3f p = point(k); return Vec3{p.x, p.y, p.z}; };
        Cluster cluster{Bounds::about(3 * (last - first), [&](int k) { return point(3 * first + k); }),
                        {}, 2};
        std::vector<Vec3> normals;
        Vec3 sum{};
        bool known = true;
        for (int k = 3 * first; k < 3 * last; k += 3) {
            const Vec3 normal = cross(widened(k + 1) - widened(k), widened(k + 2) - widened(k));
            const double length = root(dot(normal, normal));
            known &= length > 0;
            normals.push_back(normal * inverse(length));
            sum = sum + normals.back();
        }
        const double length = root(dot(sum, sum));
        double least = known ? 1 : -1;  // cosine
        const Vec3 axis = sum * inverse(length);
        for (const Vec3& normal : normals) least = std::min(least, dot(normal, axis));
        if (least > 0) {
            cluster.axis = narrow(axis);
            cluster.sine = static_cast<float>(root(std::max(1 - least * least, 0.0)));
        }
        *to++ = cluster;
    }
}

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

void Scene::draw(const Lens& lens, const View& view, const Pose* eyes, const Geom* geoms,
                 const Pose* poses, int count, const Light* lights, int light_count,
                 const Images& images) {
    lens_ = &lens;
    view_ = view;
    for (float& part : view_.fog) part = part > 0 ? std::min(part, 1.0f) : 0.0f;
    ++frame_;
    if (thresholds_.size() > 1000) thresholds_.clear();  // as colours change
    if (lights_.size() != std::size_t(light_count) ||
        (light_count && std::memcmp(lights_.data(), lights, sizeof(Light) * light_count))) {
        slots_.clear();
        lights_.assign(lights, lights + light_count);
        casters_.clear();
        for (const Light& light : lights_)
            if (light.size) casters_.push_back(light);
    }
    slots_.resize(count), placed_.resize(count), later_.resize(count);
    nearest_.resize(std::size_t(view.last - view.first) * lens.stride + widest);
    visible_.resize(std::size_t(view.last - view.first) * lens.stride + widest);
    const int steps = view.poses - 1, middle = view.poses / 2;
    middle_eye_ = eyes[middle], middle_poses_ = poses + std::size_t(middle) * count;
    const bool alone = view.height == 1;  // a single row sees what is in the middle
    step_ = steps && !alone ? (view.height - 1.0) / steps : 1.0;
    const auto row_of = [&](int pose) { return alone ? pose - 0.5 * steps : pose * step_; };
    int before = -1;  // the last pose that rows were drawn from
    for (int k = 0; k < std::max(steps, 1); ++k) {
        start_ = row_of(k);
        eye_ = eyes[k], next_eye_ = eyes[std::min(k + 1, steps)];
        const int first = std::max(static_cast<int>(std::ceil(start_)), view.first);
        const int end = k + 1 >= steps ? view.height : static_cast<int>(std::ceil(row_of(k + 1)));
        const int last = std::min(end, view.last);
        if (first >= last) continue;
        const bool follows = before >= 0 && before + 1 == k;
        if (follows) std::swap(placed_, later_);  // where all came to
        passed_ = before < 0 ? 0 : k - before, before = k;
        draw_rows(first, last, geoms, poses + std::size_t(k) * count, count, images, !follows);
    }
}

void Scene::draw_rows(int first, int last, const Geom* geoms, const Pose* poses, int count,
                      const Images& images, bool fresh) {
    first_ = first, last_ = last;
    const bool rolling = view_.poses > 1;
    std::vector<std::pair<double, int>> order, clear;
    std::int32_t parts = 0;
    for (int index = 0; index < count; ++index) {
        Placed& placed = placed_[index];
        if (!(geoms[index].rgba[3] > 0.0f)) continue;
        if (fresh) place(geoms[index], poses[index], eye_, placed);
        placed.parts = parts, parts += placed.mesh->part_count;
        if (geoms[index].double_sided) parts += placed.mesh->part_count;
        if (rolling) place(geoms[index], poses[count + index], next_eye_, later_[index]);
        if (lens_->pinhole) {
            const Bounds& bounds = placed.mesh->bounds;
            if (beyond(placed, bounds) & (rolling ? beyond(later_[index], bounds) : ~0)) continue;
        } else if (!in_squares(placed, rolling ? later_[index] : placed)) {
            continue;
        }
        const double distance = dot(placed.shift, placed.shift);
        if (distance == distance)  // else it is nowhere
            (is_solid(geoms[index]) ? order : clear).emplace_back(distance, index);
    }
    std::sort(order.begin(), order.end());  // front to back: of equal depths the first counts
    std::sort(clear.begin(), clear.end());
    // So many that no thread waits long for another, and that triangles' numbers have room for.
    const int pieces = view_.threads == 1 || rolling ? 1 : std::min(view_.threads * 4, 60);
    if (rolling && !solid_.empty()) {
        std::swap(before_, solid_[0]), std::swap(before_moving_, solid_moving_[0]);
        if (first == view_.first) before_.clear();
    }
    for (Triangles* of : {&solid_, &clear_}) {
        of->resize(pieces);
        for (auto& part : *of) part.clear();
    }
    for (Movings* of : {&solid_moving_, &clear_moving_}) {
        of->resize(pieces);
        for (auto& part : *of) part.clear();
    }
    const int rows = last - first, bands = std::min(pieces, rows);
    std::vector<std::unique_ptr<Band>> drawn(bands);
    memory_.resize(std::max<std::size_t>(memory_.size(), bands));
    const auto each = [&](auto step) {
        spread(bands, [&](int band) { if (drawn[band]) step(*drawn[band]); });
    };
    spread(bands, [&](int band) {
        const auto edge = [&](int number) {  // between the smallest squares of a lens
            if (number == 0 || number == bands) return number ? last : first;
            return std::max((first + rows * number / bands) / Lens::smallest * Lens::smallest, first);
        };
        if (edge(band) >= edge(band + 1)) return;
        drawn[band] = std::make_unique<Band>(*this, edge(band), edge(band + 1), images,
                                             memory_[band]);
        drawn[band]->clear();
    });
    const auto add_all = [&](const std::vector<int>& batch, Triangles& to, Movings& moving) {
        spread(pieces, [&](int part) {
            const std::size_t end = batch.size() * (part + 1) / pieces;
            for (std::size_t k = batch.size() * part / pieces; k < end; ++k) {
                const int index = batch[k];
                see(placed_[index]);
                if (rolling) see(later_[index]);
                if (images.rgb) light(geoms[index], middle_poses_[index], slots_[index]);
                add(index, to[part], moving[part]);
            }
        });
    };
    // In batches, each as large as half of those before it: what these hide is left out.
    const bool hiding = lens_->pinhole && !rolling;
    std::vector<int> batch;
    std::size_t triangles = 0;
    hides_ = false;
    const auto take = [&](int index) {
        if (hides_ && hidden(placed_[index], placed_[index].mesh->bounds)) return;
        batch.push_back(index);
    };
    for (auto next = order.begin(); next != order.end();) {
        batch.clear();
        const std::size_t most = std::max(smallest_batch, triangles / 2);
        std::size_t more = 0;
        for (; next != order.end() && !(hiding && more >= most); ++next) {
            const std::size_t before = batch.size();
            take(next->second);
            if (batch.size() > before) more += placed_[next->second].mesh->corners.size() / 3;
        }
        triangles += more;
        add_all(batch, solid_, solid_moving_);
        const bool is_last = next == order.end() && clear.empty();
        if (hiding && !is_last) hiding_.resize(tile(0, last + Lens::smallest));
        each([&](Band& band) {
            band.cover();
            if (hiding && !is_last) band.hide();
        });
        hides_ = hiding && !is_last;
    }
    batch.clear();
    for (auto next = clear.rbegin(); next != clear.rend(); ++next) take(next->second);
    add_all(batch, clear_, clear_moving_);  // from back to front
    if (images.rgb) each([](Band& band) { band.shade(); });
    if (images.rgb) each([](Band& band) { band.find_outlines(); });
    each([](Band& band) { band.finish(); });
}

void Scene::place(const Geom& geom, const Pose& pose, const Pose& eye, Placed& placed) {
    placed.geom = &geom;
    placed.is_seen = false;
    placed.mesh = meshes[geom.mesh].get();
    cut(placed);
    placed.shift = eye.turn.back({pose.position[0] - eye.position[0],
                                  pose.position[1] - eye.position[1],
                                  pose.position[2] - eye.position[2]});
    for (int column = 0; column < 3; ++column) {
        const Vec3 axis = eye.turn.back(
            {pose.turn.m[column], pose.turn.m[3 + column], pose.turn.m[6 + column]});
        placed.turn.m[column] = axis.x;
        placed.turn.m[3 + column] = axis.y;
        placed.turn.m[6 + column] = axis.z;
    }
}

// Find what opacity is compared with in each size of a geom's texture, if the geom has a cutoff.
void Scene::cut(Placed& placed) {
    placed.thresholds = nullptr;
    const Geom& geom = *placed.geom;
    if (!(geom.cutoff > 0)) return;
    const float least = geom.cutoff / geom.rgba[3];
    const auto [entry, is_new] = thresholds_.try_emplace({geom.texture, least});
    std::vector<float>& known = entry->second;
    if (is_new) {
        const Texture* texture = geom.texture < 0 ? nullptr : textures[geom.texture].get();
        known.assign(1, least);
        if (texture && texture->has_opacity && !texture->is_cube)
            texture->keep_coverage(texels, known);
    }
    placed.thresholds = known.data(), placed.sizes = static_cast<int>(known.size());
}

void Scene::see(Placed& placed) const {
    if (placed.is_seen) return;
    placed.is_seen = true;
    placed.seen.resize(placed.mesh->points.size());
    for (std::size_t at = 0; at < placed.seen.size(); ++at) {
        const Vec3f p = placed.mesh->points[at];
        placed.seen[at] = placed.turn * Vec3{p.x, p.y, p.z} + placed.shift;
    }
    placed.pixels.clear();
    for (const Vec3& point : placed.seen) placed.pixels.push_back(lens_->pixel(point));
}

// Edges of a pinhole's image that a box is beyond, a bit each.
int Scene::beyond(const Placed& placed, const Bounds& bounds) const {
    const float left = lens_->x[0], right = lens_->x[lens_->width - 1];
    const float top = lens_->y[first_], bottom = lens_->y[last_ - 1];
    const Vec3 middle =
        placed.turn * Vec3{bounds.middle.x, bounds.middle.y, bounds.middle.z} + placed.shift;
    const Vec3 inward[5] = {{1, 0, -left}, {-1, 0, right}, {0, 1, -top}, {0, -1, bottom}, {0, 0, 1}};
    int found = 0;
    for (int k = 0; k < 5; ++k) {
        const Vec3 along = placed.turn.back(inward[k]);
        const double reach = std::abs(along.x) * bounds.reach.x + std::abs(along.y) * bounds.reach.y +
                             std::abs(along.z) * bounds.reach.z;
        if (dot(inward[k], middle) + reach * 1.001 < 0) found |= 1 << k;
    }
    return found;
}

// Whether a box is behind what is drawn so far, in a pinhole's image: it is farther
// than the farthest in all squares of pixels in which it may be.
bool Scene::hidden(const Placed& placed, const Bounds& bounds) const {
    double low[2] = {1e30, 1e30}, high[2] = {-1e30, -1e30}, nearest = 1e30;
    for (int corner = 0; corner < 8; ++corner) {
        const auto along = [corner](int bit, float middle, float reach) {
            return double(middle) + (corner & bit ? reach : -reach);
        };
        const Vec3 at = placed.turn * Vec3{along(1, bounds.middle.x, bounds.reach.x),
                                           along(2, bounds.middle.y, bounds.reach.y),
                                           along(4, bounds.middle.z, bounds.reach.z)} + placed.shift;
        if (!(at.z >= view_.near)) return false;
        nearest = std::min(nearest, at.z);
        const Lens::Pixel pixel = lens_->pixel(at);
        low[0] = std::min(low[0], pixel.column), high[0] = std::max(high[0], pixel.column);
        low[1] = std::min(low[1], pixel.row), high[1] = std::max(high[1], pixel.row);
    }
    const auto bound = [](double at, double start, double step, int first, int last) {
        return static_cast<int>(std::min(std::max((at - start) / step, double(first)), double(last)));
    };
    const float x = lens_->x[0], y = lens_->y[0];
    const double* step = lens_->step;  // two pixels more on each side for rounding
    const int left = bound(low[0] - 2 * step[0], x, step[0], 0, lens_->width - 1);
    const int right = bound(high[0] + 2 * step[0], x, step[0], 0, lens_->width - 1);
    const int top = bound(low[1] - 2 * step[1], y, step[1], first_, last_ - 1);
    const int bottom = bound(high[1] + 2 * step[1], y, step[1], first_, last_ - 1);
    // Much more than inverse depths on a triangle are off that an eye almost in its plane sees.
    const auto most = static_cast<float>(1.01 / nearest);
    constexpr int side = Lens::smallest;
    for (int row = top / side; row <= bottom / side; ++row)
        for (int column = left / side; column <= right / side; ++column)
            if (!(hiding_[tile(column * side, row * side)] > most)) return false;
    return true;
}

// Why no triangle of a cluster is seen, as `Placed::listed` has it; 0 if one may be.
std::int32_t Scene::unseen(const Placed& placed, const Cluster& cluster) const {
    const Bounds& bounds = cluster.bounds;
    const Vec3 middle{bounds.middle.x, bounds.middle.y, bounds.middle.z};
    if (cluster.sine < 1 && !placed.geom->double_sided) {
        const Vec3 way = middle + placed.turn.back(placed.shift);  // from the eye, in the mesh's axes
        const Vec3 half{bounds.reach.x, bounds.reach.y, bounds.reach.z};
        const double reach = root(dot(half, half)), away = root(dot(way, way));
        const Vec3 axis{cluster.axis.x, cluster.axis.y, cluster.axis.z};
        // From anywhere in the ball about it, each normal is less than 90 degrees from the way.
        if (dot(way, axis) > (cluster.sine + 1e-4) * (away + reach) + reach) return Placed::faces_away;
    }
    if (!lens_->pinhole) return 0;
    if (beyond(placed, bounds) || (hides_ && hidden(placed, bounds))) return Placed::out_of_view;
    return 0;
}

// Direction of a ball from the eye and least cosine of rays that meet it. Returns the sine's square
// of the angle between them, or 1 if the eye is inside.
double Scene::ball(Vec3 middle, double reach, Vec3f& ahead, float& least) {
    const double away = dot(middle, middle), share = away > 0 ? reach / away * 1.01 : 1.0;
    if (!(share < 1.0)) {
        ahead = {}, least = -1;  // met by all
        return 1.0;
    }
    ahead = narrow(middle * (1.0 / root(away)));
    least = static_cast<float>(root(1.0 - share)) - 1e-5f;
    return share;
}

// Whether the ball about a geom, on its way, may be in view, and the smallest square of rays about it.
bool Scene::in_squares(Placed& placed, const Placed& later) const {
    const Mesh& mesh = *placed.mesh;
    const Vec3 half{mesh.bounds.reach.x, mesh.bounds.reach.y, mesh.bounds.reach.z};
    const Vec3 centre{mesh.bounds.middle.x, mesh.bounds.middle.y, mesh.bounds.middle.z};
    const Vec3 from = placed.turn * centre + placed.shift, to = later.turn * centre + later.shift;
    const double way = 0.5 * root(dot(to - from, to - from)), reach = root(dot(half, half)) + way;
    placed.square = 0, placed.column = placed.row = 0, placed.side = lens_->largest;
    Vec3f ahead;
    float least;
    if (ball((from + to) * 0.5, reach * reach, ahead, least) >= 1.0) return true;
    for (;;) {
        const Lens::Square& square = lens_->squares[placed.square];
        const int side = placed.side / 2;
        int found = bits((most(square, ahead) >= least) & (square.low[2] <= square.high[2]));
        if (placed.row >= last_ || placed.row + side <= first_) found &= ~3;
        if (placed.row + side >= last_ || placed.row + 2 * side <= first_) found &= ~12;
        if (!found) return false;
        const int part = __builtin_ctz(found);
        if (found & (found - 1) || square.parts[part] < 0) return true;
        placed.square = square.parts[part], placed.side = side;
        placed.column += part % 2 * side, placed.row += part / 2 * side;
    }
}

// Add a geom's triangles to the frame, unless they are out of view or seen from behind.
void Scene::add(int index, std::vector<Triangle>& to, std::vector<Moving>& moving) {
    Placed& placed = placed_[index];
    const bool rolling = view_.poses > 1, double_sided = placed.geom->double_sided;
    const Span<std::int32_t>& corners = placed.mesh->corners;
    double same = 0;  // 1 and twice the cosine of the turn until the next pose
    if (rolling)
        for (int k = 0; k < 9; ++k) same += placed.turn.m[k] * later_[index].turn.m[k];
    const bool turns = rolling && !(same > 2.99);
    placed.list = &to;
    if (!rolling) placed.listed.assign(corners.size() / 3, Placed::faces_away);
    const double start = lens_->pinhole ? lens_->y[0] : 0;  // of rows, and some more for rounding
    const double above = start + (first_ - 4) * lens_->step[1];
    const double below = start + (last_ + 3) * lens_->step[1];
    const Span<Cluster>& clusters = placed.mesh->clusters;
    for (std::size_t corner = 0; corner < corners.size(); corner += 3) {
        if (!rolling && corner % (3 * Cluster::most) == 0 && !clusters.empty()) {
            if (const std::int32_t why = unseen(placed, clusters[corner / (3 * Cluster::most)])) {
                const auto next = std::min(corner + 3 * Cluster::most, corners.size());
                std::fill(&placed.listed[corner / 3], placed.listed.data() + next / 3, why);
                corner = next - 3;
                continue;
            }
        }
        Vec3 points[6];  // now, and for the next pose
        Lens::Pixel pixels[6];
        const auto put = [&](const Placed& of, int first) {
            for (int k = 0; k < 3; ++k) {
                points[first + k] = of.seen[corners[corner + k]];
                pixels[first + k] = of.pixels[corners[corner + k]];
            }
        };
        const auto beyond = [&](const Placed& of) {  // bits: above these rows, below them
            int found = 3;
            for (int k = 0; k < 3; ++k) {
                const double row = of.pixels[corners[corner + k]].row;
                found &= (row < above) | (row > below) << 1;
            }
            return found;
        };
        if (rolling && lens_->pinhole && (beyond(placed) & beyond(later_[index]))) continue;
        put(placed, 0);
        const Vec3(&now)[3] = *reinterpret_cast<Vec3(*)[3]>(points);
        Triangle triangle;
        triangle.geom = index;
        triangle.corner = static_cast<int>(corner);
        triangle.part = placed.parts + placed.mesh->parts[corner / 3];
        if (!rolling) {
            const double away = dot(cross(now[1] - now[0], now[2] - now[0]), now[0]);
            triangle.behind = double_sided && away > 0;
            if (!(away < 0) && !triangle.behind) continue;
            if (triangle.behind) triangle.part += placed.mesh->part_count;
            std::int32_t& listed = placed.listed[corner / 3];
            listed = Placed::out_of_view;
            if (!bounded(triangle, points, pixels, 3, false)) continue;
            listed = static_cast<std::int32_t>(to.size());
            triangle.planes = Planes(Corners(now));
            to.push_back(triangle);
            continue;
        }
        put(later_[index], 3);
        if (!bounded(triangle, points, pixels, 6, turns)) continue;
        const Corners from(now), next(*reinterpret_cast<Vec3(*)[3]>(points + 3));
        if (from.away() >= 0 && next.away() >= 0 && !double_sided) continue;
        triangle.planes = Planes(from), triangle.behind = from.away() > 0;
        to.push_back(triangle);
        moving.push_back({from, next});
    }
}

// Find the pixels about triangles' image; false if there are none. If it turns far from one pose to
// the next, all of them: its way there is not straight.
bool Scene::bounded(Triangle& triangle, const Vec3* points, const Lens::Pixel* pixels, int count,
                    bool turns) const {
    triangle.left = 0, triangle.right = lens_->width;
    triangle.top = first_, triangle.bottom = last_;
    double low[2] = {1e30, 1e30}, high[2] = {-1e30, -1e30};
    const auto see = [&](Lens::Pixel at) {
        low[0] = std::min(low[0], at.column), high[0] = std::max(high[0], at.column);
        low[1] = std::min(low[1], at.row), high[1] = std::max(high[1], at.row);
    };
    if (!lens_->pinhole) {
        Vec3 middle{};
        double reach = 0;
        for (int k = 0; k < count; ++k) middle = middle + points[k] * (1.0 / count);
        for (int k = 0; k < count; ++k)
            reach = std::max(reach, dot(points[k] - middle, points[k] - middle));
        // What is small is in the box about its corners and the bulges of its edges.
        const double share = ball(middle, reach, triangle.ahead, triangle.least);
        if (!(share < 0.03)) return true;
        for (int k = 0; k < count; ++k) {
            const auto [column, row] = pixels[k];
            if (!(column >= 0 && column < 1e6f && row > -1e6f && row < 1e6f)) return true;
            see(pixels[k]);
        }
        // 0.0005: of `pixel`. Of a lens that sees right behind itself, more than there are pixels.
        const double more = std::min(1.5 + lens_->bend * (share + 0.0005), 1e6);
        triangle.left = std::max(triangle.left, static_cast<int>(low[0] - more));
        triangle.right = std::min(triangle.right, static_cast<int>(high[0] + more) + 1);
        triangle.top = std::max(triangle.top, static_cast<int>(low[1] - more));
        triangle.bottom = std::min(triangle.bottom, static_cast<int>(high[1] + more) + 1);
        return triangle.left < triangle.right && triangle.top < triangle.bottom;
    }
    if (turns) return true;
    const double near = view_.near;
    if (count == 3 && lens_->is_precise && points[0].z >= near && points[1].z >= near &&
        points[2].z >= near && tightly_bounded(triangle, pixels))
        return triangle.left < triangle.right && triangle.top < triangle.bottom;
    const auto cross_near = [&](Vec3 from, Vec3 to) {
        if ((from.z >= near) == (to.z >= near)) return;
        Vec3 at = from + (to - from) * ((near - from.z) / (to.z - from.z));
        at.z = near;
        see(lens_->pixel(at));
    };
    int ahead = 0;
    for (int k = 0; k < count; ++k)
        if (points[k].z >= near) see(pixels[k]), ++ahead;
    for (int k = 0; ahead && ahead < count && k < count; ++k) {
        cross_near(points[k], points[k % 3 == 2 ? k - 2 : k + 1]);
        for (int later = 3; k < 3 && later < count; ++later) cross_near(points[k], points[later]);
    }
    // Columns are at equal steps of x, rows of y; a pixel more on each side for rounding, and one
    // for a way between two poses that is not quite straight.
    const double more = count > 3 ? 2.0 : 1.0;
    const auto span = [=](double low, double high, double start, double step, int& first, int& last) {
        const double from = (low - start) / step - more, to = (high - start) / step + more + 1.0;
        if (!(to > first) || !(from < last)) return false;
        first = from > first ? static_cast<int>(from) : first;
        last = to < last ? static_cast<int>(to) : last;
        return first < last;
    };
    return span(low[1], high[1], lens_->y[0], lens_->step[1], triangle.top, triangle.bottom) &&
           span(low[0], high[0], lens_->x[0], lens_->step[0], triangle.left, triangle.right);
}

// Find the pixels that may see a triangle, and hardly more, in a pinhole's image; false for one so
// narrow, or so far from the image, that rounding may move its corners by more than this allows for.
bool Scene::tightly_bounded(Triangle& triangle, const Lens::Pixel* pixels) const {
    const double across = lens_->per_step[0], down = lens_->per_step[1];
    const double x = lens_->x[0], y = lens_->y[0];
    double u[3], v[3];
    for (int k = 0; k < 3; ++k)
        u[k] = (pixels[k].column - x) * across, v[k] = (pixels[k].row - y) * down;
    const double left = std::min(std::min(u[0], u[1]), u[2]);
    const double right = std::max(std::max(u[0], u[1]), u[2]);
    const double top = std::min(std::min(v[0], v[1]), v[2]);
    const double bottom = std::max(std::max(v[0], v[1]), v[2]);
    const double width = right - left, height = bottom - top;
    const double area = std::abs((u[1] - u[0]) * (v[2] - v[0]) - (u[2] - u[0]) * (v[1] - v[0]));
    if (!(area >= 0.05 * (width * width + height * height))) return false;
    if (!(left > -lens_->width && right < 2 * lens_->width)) return false;
    if (!(top > -lens_->height && bottom < 2 * lens_->height)) return false;
    constexpr double more = 0.125;
    triangle.left = std::max(triangle.left, static_cast<int>(std::ceil(left - more)));
    triangle.right = std::min(triangle.right, static_cast<int>(std::floor(right + more)) + 1);
    triangle.top = std::max(triangle.top, static_cast<int>(std::ceil(top - more)));
    triangle.bottom = std::min(triangle.bottom, static_cast<int>(std::floor(bottom + more)) + 1);
    return true;
}

}  // namespace raster
