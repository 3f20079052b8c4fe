// Rays that meet triangles of meshes, sorted into trees of boxes.
//
// Trees hold boxes and triangles in float and only leave out what a ray does not meet, with bounds
// that are wider than all errors of rounding. What is left is met in double in the world's axes,
// and of hits at one distance the one of the lowest geom and triangle counts: the answer depends
// neither on the trees nor on the width of vectors. A triangle is met where the ray passes on one
// side of its edges (S. Woop, C. Benthin, I. Wald, "Watertight Ray/Triangle Intersection", JCGT
// 2013), or by them within the rounding of its corners: no gap opens along an edge of two meshes.
#include <algorithm>
#include <array>
#include <limits>

#include "types.hpp"

namespace raster::rays {
namespace {

constexpr int wide = lanes;         // children of a node, triangles of a block
constexpr int bins = 16;            // places where a node may be split, along each axis
constexpr int deepest = 48;         // from there on nodes are split into halves
constexpr int most_open = 1024;     // nodes left for later: 7 at a level, of at most 48 + 31
constexpr double farthest = 1e10;   // triangles beyond it are left out: MuJoCo's numbers end there
constexpr float slack = 1.000001f;  // times a bound of a quotient: more than its rounding
constexpr float infinite = std::numeric_limits<float>::infinity();

struct alignas(sizeof(fv)) Node {
    float bounds[2][3][wide];  // lower and upper, of the children
    std::int32_t child[wide];  // number of a node, or that of a block less than -1
};

struct alignas(sizeof(fv)) Block {
    float corners[3][3][wide];  // by corner and axis; NaN where there is none
    std::int32_t geom[wide], triangle[wide];
};

struct Item {  // a triangle to be sorted into a tree
    float low[3];
    std::int32_t geom;
    float high[3];
    std::int32_t triangle;
    f4 bottom() const { return load<f4>(low); }  // and something in the last lane
    f4 top() const { return load<f4>(high); }
};

struct Box {
    f4 low = f4{} + infinite, high = f4{} - infinite;
    void add(f4 bottom, f4 top) {
        low = bottom < low ? bottom : low;
        high = top > high ? top : high;
    }
    float area() const {  // half of it
        const f4 size = high - low;
        return size[0] * size[1] + size[1] * size[2] + size[2] * size[0];
    }
};

struct Part {  // of the items, for a child
    std::int32_t begin, end;
    Box box;
    std::int32_t count() const { return end - begin; }
};

struct Surface {
    std::vector<Vec3f> points;
    std::vector<std::array<std::int32_t, 3>> corners;
};

struct Triangle {
    Vec3 a, b, c;
};

inline Vec3 widen(Vec3f a) { return {a.x, a.y, a.z}; }
inline float below(double x) {
    const auto rounded = static_cast<float>(x);
    return rounded > x ? std::nextafterf(rounded, -infinite) : rounded;
}
inline float above(double x) { return -below(-x); }
inline double at(const Vec3& a, int axis) { return (&a.x)[axis]; }

inline Vec3 placed(const Pose& pose, Vec3f point) {
    const Vec3 turned = pose.turn * widen(point);
    return {turned.x + pose.position[0], turned.y + pose.position[1], turned.z + pose.position[2]};
}

class Tree {
public:
    float size = 0;  // largest coordinate
    Box box;

    // `triangle_of` returns the corners of an item in the axes of the tree.
    template <typename Corners>
    void build(std::vector<Item>& items, Corners triangle_of) {
        for (const Item& item : items) box.add(item.bottom(), item.top());
        for (int axis = 0; axis < 3 && !items.empty(); ++axis)
            size = std::max({size, -box.low[axis], box.high[axis]});
        if (!items.empty()) {
            nodes_.emplace_back();
            fill(0, {0, static_cast<std::int32_t>(items.size()), box}, items, 0);
        }
        for (Block& block : blocks_) {
            for (int k = 0; k < wide; ++k) {
                const bool none = block.geom[k] < 0;
                const Triangle shape =
                    none ? Triangle{} : triangle_of(block.geom[k], block.triangle[k]);
                const Vec3* corners[3] = {&shape.a, &shape.b, &shape.c};
                for (int corner = 0; corner < 3; ++corner)
                    for (int axis = 0; axis < 3; ++axis)
                        block.corners[corner][axis][k] =
                            none ? std::numeric_limits<float>::quiet_NaN()
                                 : static_cast<float>(at(*corners[corner], axis));
            }
        }
    }

    const std::vector<Node>& nodes() const { return nodes_; }
    const std::vector<Block>& blocks() const { return blocks_; }

private:
    void fill(std::int32_t number, const Part& whole, std::vector<Item>& items, int depth) {
        Part parts[wide] = {whole};
        int count = 1;
        while (count < wide) {
            int largest = -1;
            for (int k = 0; k < count; ++k) {
                if (parts[k].count() <= wide) continue;
                if (largest < 0 || parts[k].box.area() > parts[largest].box.area()) largest = k;
            }
            if (largest < 0) break;
            parts[count++] = split(parts[largest], items, depth);
        }
        for (int k = 0; k < wide; ++k) {
            const Box& box = parts[k].box;  // of none: empty, which no ray meets
            for (int axis = 0; axis < 3; ++axis) {
                nodes_[number].bounds[0][axis][k] = k < count ? box.low[axis] : infinite;
                nodes_[number].bounds[1][axis][k] = k < count ? box.high[axis] : -infinite;
            }
            nodes_[number].child[k] = -1;
        }
        for (int k = 0; k < count; ++k) {
            const bool leaf = parts[k].count() <= wide;
            const auto child = static_cast<std::int32_t>(leaf ? blocks_.size() : nodes_.size());
            nodes_[number].child[k] = leaf ? -2 - child : child;
            if (!leaf) {
                nodes_.emplace_back();
                fill(child, parts[k], items, depth + 1);
                continue;
            }
            Block& block = blocks_.emplace_back();
            for (int lane = 0; lane < wide; ++lane) {
                const bool none = lane >= parts[k].count();
                block.geom[lane] = none ? -1 : items[parts[k].begin + lane].geom;
                block.triangle[lane] = none ? -1 : items[parts[k].begin + lane].triangle;
            }
        }
    }

    // Keeps the first of two parts, and returns the second: where rays meet the least, by area.
    static Part split(Part& part, std::vector<Item>& items, int depth) {
        Box middles;
        const auto middle_of = [](const Item& item) { return item.bottom() + item.top(); };
        for (auto k = part.begin; k < part.end; ++k)
            middles.add(middle_of(items[k]), middle_of(items[k]));
        const f4 extent = middles.high - middles.low;
        const auto bin_of = [&](const Item& item, int axis) {
            const float share = (middle_of(item)[axis] - middles.low[axis]) / extent[axis];
            return std::min(static_cast<int>(share * bins), bins - 1);
        };
        int axis = -1, last = 0;
        float least = infinite;
        for (int along = 0; along < 3 && depth < deepest; ++along) {
            if (!(extent[along] > 0)) continue;
            Box boxes[bins], left;
            std::int32_t counts[bins] = {};
            for (auto k = part.begin; k < part.end; ++k) {
                const int bin = bin_of(items[k], along);
                boxes[bin].add(items[k].bottom(), items[k].top());
                ++counts[bin];
            }
            float costs[bins];
            std::int32_t count = 0;
            const auto cost = [](const Box& box, std::int32_t triangles) {
                return box.area() * static_cast<float>((triangles + wide - 1) / wide);
            };
            Box right;
            for (int bin = bins - 1; bin > 0; --bin) {
                right.add(boxes[bin].low, boxes[bin].high);
                count += counts[bin];
                costs[bin] = count ? cost(right, count) : infinite;
            }
            count = 0;
            for (int bin = 0; bin + 1 < bins; ++bin) {
                left.add(boxes[bin].low, boxes[bin].high);
                count += counts[bin];
                if (!count) continue;
                const float sum = cost(left, count) + costs[bin + 1];
                if (sum < least) least = sum, axis = along, last = bin;
            }
        }
        auto border = part.begin + part.count() / 2;
        if (axis >= 0) {
            const auto first = items.begin() + part.begin;
            border = part.begin + static_cast<std::int32_t>(
                std::partition(first, items.begin() + part.end, [&](const Item& item) {
                    return bin_of(item, axis) <= last;
                }) - first);
        }
        Part second{border, part.end, {}};
        part = {part.begin, border, {}};
        for (Part* half : {&part, &second})
            for (auto k = half->begin; k < half->end; ++k)
                half->box.add(items[k].bottom(), items[k].top());
        return second;
    }

    std::vector<Node> nodes_;
    std::vector<Block> blocks_;
};

struct Hit {
    double distance;
    std::int32_t geom, triangle;
    bool operator<(const Hit& other) const {
        if (distance != other.distance) return distance < other.distance;
        return geom != other.geom ? geom < other.geom : triangle < other.triangle;
    }
};

// A ray in double, with z along the axis in which it is longest, and sheared to be only that.
struct Line {
    Vec3 origin, direction;
    int x, y, z;
    double length, slope_x, slope_y, sign;  // length: along z

    Line(Vec3 from, Vec3 along) : origin(from), direction(along) {
        const Vec3 size{std::fabs(along.x), std::fabs(along.y), std::fabs(along.z)};
        z = size.x >= size.y && size.x >= size.z ? 0 : size.y >= size.z ? 1 : 2;
        x = (z + 1) % 3, y = (z + 2) % 3;
        length = at(size, z);
        slope_x = at(along, x) / at(along, z);
        slope_y = at(along, y) / at(along, z);
        sign = std::copysign(1.0, at(along, z));
    }
    static bool is_one(Vec3 from, Vec3 along) {
        const double reach = std::fabs(from.x) + std::fabs(from.y) + std::fabs(from.z);
        const double size = std::fabs(along.x) + std::fabs(along.y) + std::fabs(along.z);
        return reach < 1e15 && size > 1e-30 && size < 1e30;  // neither is NaN
    }
    Vec3 sheared(Vec3 point) const {
        const Vec3 away = point - origin;
        const double ahead = at(away, z);
        return {at(away, x) - slope_x * ahead, at(away, y) - slope_y * ahead, sign * ahead};
    }

    // The distance in lengths of the direction; NaN for none. `margin`: by which edges count wider.
    double meets(const Triangle& shape, double margin) const {
        const Vec3 a = sheared(shape.a), b = sheared(shape.b), c = sheared(shape.c);
        double u = c.x * b.y - c.y * b.x, v = a.x * c.y - a.y * c.x, w = b.x * a.y - b.y * a.x;
        double area = u + v + w;
        if (area < 0) u = -u, v = -v, w = -w, area = -area;
        const double none = std::numeric_limits<double>::quiet_NaN();
        if (u < 0 || v < 0 || w < 0) {
            // Of a sliver not more than a share of it: beyond its edges its plane leads far away.
            const auto outside = [&](double side, const Vec3& from, const Vec3& to) {
                const Vec3 edge{to.x - from.x, to.y - from.y, 0};
                return -side > std::min(margin * root(dot(edge, edge)), area * 0x1p-10);
            };
            if (outside(u, b, c) || outside(v, c, a) || outside(w, a, b)) return none;
        }
        const double size = std::max({std::fabs(a.x), std::fabs(a.y), std::fabs(b.x),
                                      std::fabs(b.y), std::fabs(c.x), std::fabs(c.y)});
        if (!(area > 0x1p-46 * size * size)) return none;  // seen from its edge, or none at all
        const double ahead = (u * a.z + v * b.z + w * c.z) / area;
        return ahead >= 0 ? ahead / length : none;
    }
};

// The same in the axes of a tree, in float, with all errors bounded.
struct Beam {
    fv near_origin[3], far_origin[3], inverse[3];
    int far_side[3];  // 0 where it goes down: the side by which it leaves a box
    int x, y, z;
    float origin[3], slope_x, slope_y, sign, error;

    Beam(const Line& line, float size) : x(line.x), y(line.y), z(line.z) {
        float largest = size;
        for (int axis = 0; axis < 3; ++axis) {
            origin[axis] = static_cast<float>(at(line.origin, axis));
            largest = std::max(largest, std::fabs(origin[axis]));
        }
        // Rounded are the origin, bounds and corners, and their differences; some of it twice.
        const float wider = 0x1p-20f * largest;
        error = 0x1p-19f * largest;
        slope_x = static_cast<float>(line.slope_x);
        slope_y = static_cast<float>(line.slope_y);
        sign = static_cast<float>(line.sign);
        for (int axis = 0; axis < 3; ++axis) {
            const double along = at(line.direction, axis) / line.length;
            const bool down = std::signbit(along);
            const double limited = std::max(std::fabs(along), 1e-30);
            const auto quotient = static_cast<float>(1 / limited);
            inverse[axis] = fv{} + (down ? -quotient : quotient);
            near_origin[axis] = fv{} + (origin[axis] + (down ? -wider : wider));
            far_origin[axis] = fv{} + (origin[axis] - (down ? -wider : wider));
            far_side[axis] = down ? 0 : 1;
        }
    }

    // Which of the boxes are met before a distance, and at which each is entered.
    iv enters(const Node& node, float before, fv& entered) const {
        fv near{}, far = fv{} + before;
        for (int axis = 0; axis < 3; ++axis) {
            const int side = far_side[axis];
            const fv first =
                (load<fv>(node.bounds[1 - side][axis]) - near_origin[axis]) * inverse[axis];
            const fv second =
                (load<fv>(node.bounds[side][axis]) - far_origin[axis]) * inverse[axis];
            near = first > near ? first : near;
            far = second < far ? second : far;
        }
        entered = near;
        return near <= far * slack;
    }

    // Which of the triangles may be met before a distance.
    iv may_meet(const Block& block, float before) const {
        fv px[3], py[3], size[3], least{}, most{};
        for (int corner = 0; corner < 3; ++corner) {
            const auto& places = block.corners[corner];
            const fv ahead = load<fv>(places[z]) - origin[z];
            px[corner] = (load<fv>(places[x]) - origin[x]) - slope_x * ahead;
            py[corner] = (load<fv>(places[y]) - origin[y]) - slope_y * ahead;
            const fv across = px[corner] < 0 ? -px[corner] : px[corner];
            size[corner] = across + (py[corner] < 0 ? -py[corner] : py[corner]);
            const fv depth = sign * ahead;
            least = !corner || depth < least ? depth : least;
            most = !corner || depth > most ? depth : most;
        }
        iv over = (least <= before + error) & (most >= -error), under = over;
        for (int corner = 0; corner < 3; ++corner) {
            const int from = (corner + 1) % 3, to = (corner + 2) % 3;
            const fv side = px[to] * py[from] - py[to] * px[from];
            const fv bound = 3 * error * (size[from] + size[to] + 2 * error);
            over &= side >= -bound;
            under &= side <= bound;
        }
        return over | under;
    }
};

inline unsigned which(iv mask) { return static_cast<unsigned>(bits(mask)); }

}  // namespace

// Meshes at their places, those that stand still in one tree.
class Rays {
public:
    int add_mesh(int vertices, const float* points, int triangles, const std::int32_t* corners) {
        Surface& surface = surfaces_.emplace_back();
        for (int k = 0; k < vertices; ++k)
            surface.points.push_back({points[3 * k], points[3 * k + 1], points[3 * k + 2]});
        for (int k = 0; k < triangles; ++k)
            surface.corners.push_back({corners[3 * k], corners[3 * k + 1], corners[3 * k + 2]});
        return static_cast<int>(surfaces_.size()) - 1;
    }

    void build(int geoms, const std::int32_t* numbers, const std::int32_t* meshes,
               const std::uint8_t* moves, const double* positions, const double* turns) {
        std::vector<Item> items;
        trees_.resize(surfaces_.size());
        for (int k = 0; k < geoms; ++k) {
            Body body{numbers[k], meshes[k], pose_of(numbers[k], positions, turns), 0};
            const Surface& surface = surfaces_[meshes[k]];
            float largest = 0;
            for (const Vec3f& p : surface.points)
                largest = std::max({largest, std::fabs(p.x), std::fabs(p.y), std::fabs(p.z)});
            body.margin = 0x1p-22 * largest;
            bodies_.push_back(body);
            if (!moves[k]) {
                collect(k, body.pose, items);
                continue;
            }
            moving_.push_back(k);
            std::unique_ptr<Tree>& tree = trees_[meshes[k]];
            if (tree) continue;
            tree = std::make_unique<Tree>();
            Pose still{{0, 0, 0}, {{1, 0, 0, 0, 1, 0, 0, 0, 1}}};
            std::vector<Item> own;
            collect(k, still, own);
            tree->build(own, [&](std::int32_t, std::int32_t triangle) {
                return triangle_of(meshes[k], triangle, still);
            });
        }
        still_.build(items, [&](std::int32_t body, std::int32_t triangle) {
            return triangle_of(bodies_[body].mesh, triangle, bodies_[body].pose);
        });
    }

    void cast(const double* positions, const double* turns, const std::uint8_t* wanted,
              Vec3 origin, int count, const double* directions, double* distances,
              std::int32_t* geoms, double* normals, std::int32_t* triangles) const {
        std::vector<Pose> poses;
        for (const Body& body : bodies_) poses.push_back(body.pose);
        for (const int k : moving_) poses[k] = pose_of(bodies_[k].number, positions, turns);
        const std::vector<Node> movers = around_moving(poses, wanted);
        float size = 0;
        for (const Node& node : movers)
            for (int axis = 0; axis < 3; ++axis)
                for (int k = 0; k < wide; ++k)
                    if (node.child[k] >= 0)
                        size = std::max({size, -node.bounds[0][axis][k], node.bounds[1][axis][k]});
        const Cast cast{*this, poses, wanted};
        for (int k = 0; k < count; ++k) {
            const Vec3 along{directions[3 * k], directions[3 * k + 1], directions[3 * k + 2]};
            if (!Line::is_one(origin, along)) continue;
            const Line line(origin, along);
            const bool none = geoms[k] < 0;
            Best best{{none ? std::numeric_limits<double>::infinity() : distances[k], geoms[k], -1},
                      -1, infinite};
            best.bound(line.length);
            cast.through(still_, line, line, -1, best);
            if (!movers.empty()) cast.through_moving(movers, size, line, best);
            if (triangles) triangles[k] = best.hit.triangle;
            if (best.body < 0) continue;
            distances[k] = best.hit.distance;
            geoms[k] = best.hit.geom;
            if (!normals) continue;
            const Triangle shape =
                triangle_of(bodies_[best.body].mesh, best.hit.triangle, poses[best.body]);
            const Vec3 across = cross(shape.b - shape.a, shape.c - shape.a);
            const double length = root(dot(across, across));
            const Vec3 normal = length > 0 ? across * (1 / length) : Vec3{0, 0, 0};
            std::memcpy(normals + 3 * k, &normal, sizeof normal);
        }
    }

private:
    struct Body {
        std::int32_t number, mesh;  // of the geom, of the surface
        Pose pose;
        double margin;
    };

    struct Best {
        Hit hit;
        int body;
        float before;  // not less than the distance, along the line's z
        void bound(double length) {
            before = hit.distance * length < farthest * farthest
                         ? static_cast<float>(hit.distance * length) * slack
                         : infinite;
        }
    };

    struct Cast {
        const Rays& rays;
        const std::vector<Pose>& poses;
        const std::uint8_t* wanted;

        // `own` is the line in the axes of the tree, which may be that of one body.
        void through(const Tree& tree, const Line& line, const Line& own, int body,
                     Best& best) const {
            if (tree.nodes().empty()) return;
            const Beam beam(own, tree.size);
            // Distances along z of both differ by this factor.
            const auto scale = static_cast<float>(own.length / line.length) * slack;
            struct Open {
                float entered;
                std::int32_t child;
            } open[most_open];
            int count = 0;
            std::int32_t child = 0;
            float before = best.before * scale;
            for (;;) {
                if (child >= 0) {
                    const Node& node = tree.nodes()[child];
                    fv entered;
                    unsigned left = which(beam.enters(node, before, entered));
                    if (left) {
                        int lane = __builtin_ctz(left);
                        Open nearest{entered[lane], node.child[lane]};
                        const int first = count;
                        while (left &= left - 1) {
                            lane = __builtin_ctz(left);
                            Open other{entered[lane], node.child[lane]};
                            if (other.entered < nearest.entered) std::swap(other, nearest);
                            int place = count++;  // the nearest of the rest is the last
                            for (; place > first && open[place - 1].entered < other.entered;
                                 --place)
                                open[place] = open[place - 1];
                            open[place] = other;
                        }
                        child = nearest.child;
                        continue;
                    }
                } else {
                    const Block& block = tree.blocks()[-2 - child];
                    for (unsigned left = which(beam.may_meet(block, before)); left;
                         left &= left - 1) {
                        const int lane = __builtin_ctz(left);
                        meet(line, body < 0 ? block.geom[lane] : body, block.triangle[lane], best);
                        before = best.before * scale;
                    }
                }
                do {
                    if (!count) return;
                    --count;
                } while (open[count].entered > before);
                child = open[count].child;
            }
        }

        void through_moving(const std::vector<Node>& movers, float size, const Line& line,
                            Best& best) const {
            const Beam beam(line, size);
            for (const Node& node : movers) {
                fv entered;
                for (unsigned left = which(beam.enters(node, best.before, entered)); left;
                     left &= left - 1) {
                    const int body = node.child[__builtin_ctz(left)];
                    if (body < 0) continue;
                    const Pose& pose = poses[body];
                    const Vec3 from{line.origin.x - pose.position[0],
                                    line.origin.y - pose.position[1],
                                    line.origin.z - pose.position[2]};
                    const Vec3 along = pose.turn.back(line.direction);
                    if (!Line::is_one(pose.turn.back(from), along)) continue;
                    const Line own(pose.turn.back(from), along);
                    through(*rays.trees_[rays.bodies_[body].mesh], line, own, body, best);
                }
            }
        }

        void meet(const Line& line, int number, std::int32_t triangle, Best& best) const {
            if (!wanted[number]) return;
            const Body& body = rays.bodies_[number];
            const Triangle shape = rays.triangle_of(body.mesh, triangle, poses[number]);
            const Hit hit{line.meets(shape, body.margin), body.number, triangle};
            if (std::isnan(hit.distance) || !(hit < best.hit)) return;
            best.hit = hit;
            best.body = number;
            best.bound(line.length);
        }
    };

    static Pose pose_of(std::int32_t geom, const double* positions, const double* turns) {
        Pose pose;
        std::memcpy(pose.position, positions + 3 * geom, sizeof pose.position);
        std::memcpy(pose.turn.m, turns + 9 * geom, sizeof pose.turn.m);
        return pose;
    }

    static bool is_pose(const Pose& pose) {
        bool inside = true;  // and no number is NaN
        for (const double place : pose.position) inside &= std::fabs(place) <= farthest;
        for (const double turn : pose.turn.m) inside &= std::fabs(turn) < 1.5;
        return inside;
    }

    Triangle triangle_of(std::int32_t mesh, std::int32_t triangle, const Pose& pose) const {
        const Surface& surface = surfaces_[mesh];
        const auto& [a, b, c] = surface.corners[triangle];
        return {placed(pose, surface.points[a]), placed(pose, surface.points[b]),
                placed(pose, surface.points[c])};
    }

    void collect(int body, const Pose& pose, std::vector<Item>& items) const {
        const std::int32_t mesh = bodies_[body].mesh;
        const auto count = static_cast<std::int32_t>(surfaces_[mesh].corners.size());
        for (std::int32_t number = 0; number < count; ++number) {
            const Triangle shape = triangle_of(mesh, number, pose);
            Item item{{}, body, {}, number};
            bool inside = true;
            for (int axis = 0; axis < 3; ++axis) {
                const double a = at(shape.a, axis), b = at(shape.b, axis), c = at(shape.c, axis);
                inside &= std::fabs(a) <= farthest && std::fabs(b) <= farthest &&
                          std::fabs(c) <= farthest;
                if (!inside) break;
                item.low[axis] = below(std::min({a, b, c}));
                item.high[axis] = above(std::max({a, b, c}));
            }
            if (inside) items.push_back(item);
        }
    }

    // Boxes around all that move and are wanted, in the world's axes; children are the bodies.
    std::vector<Node> around_moving(const std::vector<Pose>& poses,
                                    const std::uint8_t* wanted) const {
        std::vector<Node> nodes;
        int lane = wide;
        for (const int body : moving_) {
            const Tree& tree = *trees_[bodies_[body].mesh];
            if (!wanted[body] || tree.nodes().empty() || !is_pose(poses[body])) continue;
            if (lane == wide) {
                lane = 0;
                Node& node = nodes.emplace_back();
                for (int k = 0; k < wide; ++k) {
                    for (int axis = 0; axis < 3; ++axis) {
                        node.bounds[0][axis][k] = infinite;
                        node.bounds[1][axis][k] = -infinite;
                    }
                    node.child[k] = -1;
                }
            }
            const f4 low = tree.box.low, high = tree.box.high;
            for (int axis = 0; axis < 3; ++axis) {
                double middle = poses[body].position[axis], half = 0;
                for (int k = 0; k < 3; ++k) {
                    const double turn = poses[body].turn.m[3 * axis + k];
                    middle += turn * (0.5 * (static_cast<double>(low[k]) + high[k]));
                    half += std::fabs(turn) * (0.5 * (static_cast<double>(high[k]) - low[k]));
                }
                nodes.back().bounds[0][axis][lane] = below(middle - half);
                nodes.back().bounds[1][axis][lane] = above(middle + half);
            }
            nodes.back().child[lane++] = body;
        }
        return nodes;
    }

    std::vector<Surface> surfaces_;
    std::vector<Body> bodies_;
    std::vector<int> moving_;
    std::vector<std::unique_ptr<Tree>> trees_;  // of the meshes of what moves
    Tree still_;
};

}  // namespace raster::rays

using raster::rays::Rays;

extern "C" {
#pragma GCC visibility push(default)

// Called by `ray_casting.py`, which checks all sizes.

Rays* rays_new() { return new Rays; }

void rays_free(Rays* rays) { delete rays; }

int rays_mesh(Rays* rays, int vertices, const float* points, int triangles,
              const std::int32_t* corners) {
    return rays->add_mesh(vertices, points, triangles, corners);
}

// Called once, after the meshes. Numbers of geoms lead into positions and turns, as of MjData.
void rays_build(Rays* rays, int geoms, const std::int32_t* numbers, const std::int32_t* meshes,
                const std::uint8_t* moves, const double* positions, const double* turns) {
    rays->build(geoms, numbers, meshes, moves, positions, turns);
}

// Hits of other geoms come in as distances and numbers (-1: none) and leave if none is nearer.
// `wanted` is by the order of `rays_build`; normals and triangles may be null.
void rays_cast(const Rays* rays, const double* positions, const double* turns,
               const std::uint8_t* wanted, const double* origin, int count,
               const double* directions, double* distances, std::int32_t* geoms, double* normals,
               std::int32_t* triangles) {
    rays->cast(positions, turns, wanted, {origin[0], origin[1], origin[2]}, count, directions,
               distances, geoms, normals, triangles);
}

#pragma GCC visibility pop
}  // extern "C"
