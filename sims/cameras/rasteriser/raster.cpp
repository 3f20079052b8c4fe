// A rasteriser of textured triangles: colour, depth and object numbers of one visibility buffer.
//
// Every pixel has a ray; a triangle, seen from the eye, is three planes through its edges, and its
// inverse depth and all that is interpolated on it are linear in the ray (M. Olano, T. Greer,
// "Triangle Scan Conversion using 2D Homogeneous Coordinates", Graphics Hardware 1997). So nothing
// is clipped, and any lens is drawn directly. First each pixel learns which triangle is nearest;
// then runs of pixels of one triangle are shaded together.
#include <limits>

#include "lighting.hpp"
#include "texture.hpp"
#include "types.hpp"

namespace raster {

struct Mesh {
    std::vector<Vec3f> points, normals;
    std::vector<float> places;          // in a texture, u and v of each vertex
    std::vector<std::int32_t> corners;  // three of each triangle, counterclockwise from outside
    Vec3f middle, reach;                // of the box about it
};

struct Lens {  // rays of all pixels: of a pinhole x by column and y by row, else all by pixel
    bool pinhole;
    int width, height, stride;
    float pitch[2];  // of a pinhole: a pixel's width and height at z = 1
    std::vector<float> x, y, z;
    struct Box {
        float low[3], high[3];
    };
    struct Grid {  // boxes about the rays of each `side` x `side` pixels
        int side, across;
        std::vector<Box> boxes;
    };
    Grid coarse, fine;
};

struct Triangle {
    float depth[3];     // inverse depth, times the ray
    float edges[3][3];  // positive inside
    std::int32_t geom, corner;
    int left, right, top, bottom;  // pixels that it may cover: to right - 1 and bottom - 1
};

struct Surface {  // what is interpolated on a triangle, each times the ray
    float u[3], v[3], w[3];  // w of a cube, in which they are a direction
    float light[3][3];
    bool flat;
    float same[3];  // the light of a flat one
    const Texture* texture;
    float width, height;  // of its finest level, texels
    float opacity;
};

struct Placed {  // a geom of the frame
    Geom geom;
    Vec3 shift;               // of its mesh's origin from the eye, in the optical frame
    Matrix turn;              // from the mesh's axes to the optical frame
    std::vector<Vec3> seen;   // its vertices in the optical frame
    const Vec3f* light = nullptr;  // of its vertices; if it is see-through, then from behind
};

class Scene {
  public:
    std::vector<std::unique_ptr<Mesh>> meshes;
    std::vector<std::unique_ptr<Texture>> textures;
    std::vector<std::unique_ptr<Lens>> lenses;

    void draw(const Lens& lens, const View& view, const Geom* geoms, int count,
              const Light* lights, int light_count, std::uint8_t* rgb, float* depth,
              std::int32_t* numbers);

  private:
    struct Slot {  // light of a geom's vertices that holds until something moves
        Geom geom;
        std::vector<Vec3f> light;
    };

    void place(const Geom& geom, int index);
    void add(int geom, int corner, bool blended);
    bool bounded(Triangle& triangle, const Vec3 (&points)[3]) const;
    bool in_view(const Placed& placed, const Mesh& mesh) const;
    void cover(const Triangle& triangle, std::int32_t number);
    template <typename Found>
    void over(const Triangle& triangle, Found found) const;
    template <bool pinhole, typename Found>
    void scan(const Triangle& triangle, Found found) const;
    const Surface& surface(std::int32_t number);
    void light(Placed& placed, int index);
    void shade(std::uint8_t* rgb);
    void shade_run(std::uint8_t* row, int y, int left, int right, std::int32_t number);
    void shade_sky(std::uint8_t* row, int y, int left, int right);
    void blend(std::uint8_t* rgb);
    static bool owns(const Triangle& triangle, Vec3f ray);
    void colours(const Surface& surface, const Triangle& triangle, int x, int y, f8 q, int count,
                 f4* found) const;
    int detail_of(const Surface& surface, const Triangle& triangle, int x, int y, float inverse,
                  float u, float v) const;
    int detail_around(const Surface& surface, const Triangle& triangle, int x, int y, float inverse,
                      Vec3f at) const;
    void steps(int x, int y, Vec3f& right, Vec3f& below) const;
    Vec3f ray(int x, int y) const {
        if (lens_->pinhole) return {lens_->x[x], lens_->y[y], 1.0f};
        const std::size_t at = std::size_t(y) * lens_->stride + x;
        return {lens_->x[at], lens_->y[at], lens_->z[at]};
    }
    static float times(const float (&plane)[3], Vec3f ray) {
        return plane[0] * ray.x + (plane[1] * ray.y + plane[2] * ray.z);
    }

    const Lens* lens_ = nullptr;
    View view_{};
    std::vector<Light> lights_;
    bool eye_matters_ = false;  // to the light on surfaces
    const std::uint8_t* end_ = nullptr;  // of the image
    std::vector<Placed> placed_;
    std::vector<Slot> slots_;
    std::vector<Light> slots_lights_;
    std::vector<Triangle> triangles_;
    std::vector<Surface> surfaces_;
    std::vector<std::int32_t> surface_of_;
    std::vector<std::int32_t> blended_;
    std::vector<float> nearest_;  // inverse depth of the nearest opaque surface; 0 for nothing
    std::vector<float> front_;    // of the nearest of all
    std::vector<std::int32_t> visible_;  // its triangle
};

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
    std::sort(order.begin(), order.end());  // front to back; the opaque ones in any order alike
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
    for (int y = 0; y < rows; ++y)
        for (int x = 0; x < lens.width; ++x) {
            const std::size_t from = std::size_t(y) * lens.stride + x;
            const std::size_t to = std::size_t(y) * lens.width + x;
            if (numbers) {
                const std::int32_t seen = visible_[from];
                numbers[to] = seen < 0 ? -1 : placed_[triangles_[seen].geom].geom.number;
            }
            if (depth) {
                float z = nearest_[from] > 0.0f ? 1.0f / nearest_[from] : view.far * 2.0f;
                if (!lens.pinhole) {
                    const float ahead = ray(x, y + view.first).z;
                    z = ahead > 0.0f ? z * ahead : view.far * 2.0f;
                }
                depth[to] = z > view.far ? std::numeric_limits<float>::infinity() : z;
            }
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

// Light on a geom's vertices; that of before, if nothing has moved.
void Scene::light(Placed& placed, int index) {
    const Mesh& mesh = *meshes[placed.geom.mesh];
    const Geom& geom = placed.geom;
    Slot& slot = slots_[index];
    bool shines = false;
    for (const Light& each : lights_)
        shines |= geom.specular > 0 && (each.specular[0] + each.specular[1] + each.specular[2]) > 0;
    const int sides = geom.culled ? 1 : 2;
    if (!shines && slot.light.size() == sides * mesh.points.size() &&
        !std::memcmp(&slot.geom, &geom, sizeof geom)) {
        placed.light = slot.light.data();
        return;
    }
    const Vec3 eye{view_.position[0], view_.position[1], view_.position[2]};
    const Vec3 origin{geom.position[0], geom.position[1], geom.position[2]};
    slot.light.clear();
    for (int side = 0; side < sides; ++side)
        for (std::size_t k = 0; k < mesh.points.size(); ++k) {
            const Vec3f p = mesh.points[k], n = mesh.normals[k];
            const Vec3 normal = unit(geom.turn * Vec3{n.x, n.y, n.z}) * (side ? -1.0 : 1.0);
            const Vec3 point = geom.turn * Vec3{p.x, p.y, p.z} + origin;
            slot.light.push_back(lit(geom, lights_, point, normal, eye));
        }
    slot.geom = geom;
    placed.light = slot.light.data();
}

// Planes of all that is interpolated on a triangle, computed when its first pixel is shaded.
const Surface& Scene::surface(std::int32_t number) {
    if (surface_of_[number] >= 0) return surfaces_[surface_of_[number]];
    surface_of_[number] = static_cast<std::int32_t>(surfaces_.size());
    const Triangle& triangle = triangles_[number];
    Placed& placed = placed_[triangle.geom];
    if (!placed.light) light(placed, triangle.geom);
    const Mesh& mesh = *meshes[placed.geom.mesh];
    const std::int32_t* corners = mesh.corners.data() + triangle.corner;
    const Vec3 points[3] = {placed.seen[corners[0]], placed.seen[corners[1]],
                            placed.seen[corners[2]]};
    const double share =
        1.0 / dot(cross(points[1] - points[0], points[2] - points[0]), points[0]);
    Vec3 weights[3];  // of the corners, times the ray and its length
    for (int k = 0; k < 3; ++k)
        weights[k] = cross(points[(k + 1) % 3], points[(k + 2) % 3]) * share;
    const auto plane = [&](float (&to)[3], float a, float b, float c) {
        const Vec3 sum = weights[0] * double(a) + weights[1] * double(b) + weights[2] * double(c);
        to[0] = static_cast<float>(sum.x);
        to[1] = static_cast<float>(sum.y);
        to[2] = static_cast<float>(sum.z);
    };
    Surface made{};
    made.texture = nullptr;
    if (placed.geom.texture >= 0) {
        made.texture = textures[placed.geom.texture].get();
        made.width = static_cast<float>(made.texture->level(0).width);
        made.height = static_cast<float>(made.texture->level(0).height);
        const float* at = mesh.places.data();
        const auto place = [&](int k, int axis) {
            return at[2 * corners[k] + axis] * placed.geom.repeat[axis] + placed.geom.offset;
        };
        if (made.texture->is_cube) {
            const float(&scale)[3] = placed.geom.cube;
            const Vec3f a = mesh.points[corners[0]], b = mesh.points[corners[1]];
            const Vec3f c = mesh.points[corners[2]];
            plane(made.u, a.x * scale[0], b.x * scale[0], c.x * scale[0]);
            plane(made.v, a.y * scale[1], b.y * scale[1], c.y * scale[1]);
            plane(made.w, a.z * scale[2], b.z * scale[2], c.z * scale[2]);
        } else {
            plane(made.u, place(0, 0), place(1, 0), place(2, 0));
            plane(made.v, place(0, 1), place(1, 1), place(2, 1));
        }
    }
    const Vec3f* light = placed.light + (share > 0 ? mesh.points.size() : 0);
    const Vec3f l[3] = {light[corners[0]], light[corners[1]], light[corners[2]]};
    made.flat = !std::memcmp(&l[0], &l[1], sizeof l[0]) && !std::memcmp(&l[0], &l[2], sizeof l[0]);
    made.same[0] = l[0].x, made.same[1] = l[0].y, made.same[2] = l[0].z;
    if (!made.flat) {
        plane(made.light[0], l[0].x, l[1].x, l[2].x);
        plane(made.light[1], l[0].y, l[1].y, l[2].y);
        plane(made.light[2], l[0].z, l[1].z, l[2].z);
    }
    made.opacity = placed.geom.rgba[3];
    surfaces_.push_back(made);
    return surfaces_.back();
}

// Rays of a step to the right and of one down, beside a pixel's.
inline void Scene::steps(int x, int y, Vec3f& right, Vec3f& below) const {
    if (lens_->pinhole) {
        right = {lens_->pitch[0], 0, 0};
        below = {0, lens_->pitch[1], 0};
    } else {
        const Vec3f here = ray(x, y);
        right = ray(std::min(x + 1, lens_->width - 1), y) - here;
        below = ray(x, std::min(y + 1, lens_->height - 1)) - here;
    }
}

// Level of a mipmap, in 256ths, whose texels are as large as a pixel that covers so many of the
// finest, squared.
inline int level_of(float most, const Texture& texture) {
    if (!(most > 1.0f)) return 0;  // also where a ray's neighbour is none
    const int detail = static_cast<int>(128.0f * log_2(most));
    return std::min(detail, (texture.levels() - 1) << 8);
}

inline int Scene::detail_of(const Surface& surface, const Triangle& triangle, int x, int y,
                            float inverse, float u, float v) const {
    const float width = inverse * surface.width, height = inverse * surface.height;
    Vec3f right, below;
    steps(x, y, right, below);
    const auto step = [&](Vec3f along) {
        const float dq = times(triangle.depth, along);
        const float across = (times(surface.u, along) - u * dq) * width;
        const float down = (times(surface.v, along) - v * dq) * height;
        return across * across + down * down;
    };
    return level_of(std::max(step(right), step(below)), *surface.texture);
}

inline int Scene::detail_around(const Surface& surface, const Triangle& triangle, int x, int y,
                                float inverse, Vec3f at) const {
    const auto size = [](float value) { return value < 0 ? -value : value; };
    const float most = std::max({size(at.x), size(at.y), size(at.z), 1e-20f});
    const float scale = inverse * 0.5f * surface.width / most;
    Vec3f right, below;
    steps(x, y, right, below);
    const auto step = [&](Vec3f along) {
        const float dq = times(triangle.depth, along);
        const Vec3f moved = (Vec3f{times(surface.u, along), times(surface.v, along),
                                   times(surface.w, along)} - at * dq) * scale;
        return dot(moved, moved);
    };
    return level_of(std::max(step(right), step(below)), *surface.texture);
}

// Colours (0 to 255) of `count` pixels of a triangle in a row, from x on; `q`: their inverse depth.
inline void Scene::colours(const Surface& surface, const Triangle& triangle, int x, int y, f8 q,
                           int count, f4* found) const {
    const f8 inverse = 1.0f / q;
    f8 rx, ry = f8{} + (lens_->pinhole ? lens_->y[y] : 0.0f), rz = f8{} + 1.0f;
    if (lens_->pinhole) {
        rx = load(&lens_->x[x]);
    } else {
        const std::size_t at = std::size_t(y) * lens_->stride + x;
        rx = load(&lens_->x[at]), ry = load(&lens_->y[at]), rz = load(&lens_->z[at]);
    }
    const auto times = [&](const float(&plane)[3]) {
        return (rx * plane[0] + (ry * plane[1] + rz * plane[2])) * inverse;
    };
    const int middle = count / 2;
    if (surface.texture && surface.texture->is_cube) {
        const f8 u = times(surface.u), v = times(surface.v), w = times(surface.w);
        const int detail = detail_around(surface, triangle, x + middle, y, inverse[middle],
                                         {u[middle], v[middle], w[middle]});
        for (int k = 0; k < count; ++k)
            found[k] = surface.texture->around({u[k], v[k], w[k]}, detail);
    } else if (surface.texture) {
        const f8 u = times(surface.u), v = times(surface.v);
        const int detail =
            detail_of(surface, triangle, x + middle, y, inverse[middle], u[middle], v[middle]);
        surface.texture->sample(u, v, count, detail, found);
    } else {
        for (int k = 0; k < count; ++k) found[k] = f4{} + 65280.0f;
    }
    if (surface.flat) {
        const f4 light = f4{surface.same[0], surface.same[1], surface.same[2], 0} * (1.0f / 256);
        for (int k = 0; k < count; ++k) found[k] *= light;
    } else {
        const f8 r = times(surface.light[0]) * (1.0f / 256);
        const f8 g = times(surface.light[1]) * (1.0f / 256);
        const f8 b = times(surface.light[2]) * (1.0f / 256);
        for (int k = 0; k < count; ++k) found[k] *= f4{r[k], g[k], b[k], 0};
    }
    if (view_.fogged) {
        const f8 clear = (view_.fog_end - inverse * rz) / (view_.fog_end - view_.fog_start);
        const f4 fog{view_.fog[0], view_.fog[1], view_.fog[2], 0};
        for (int k = 0; k < count; ++k) {
            const float share = std::min(std::max(clear[k], 0.0f), 1.0f);
            found[k] = found[k] * share + fog * (255.0f * (1.0f - share));
        }
    }
}

// Write a pixel and, where there is room, a byte after it, which the next pixel will overwrite.
inline void write(std::uint8_t* to, f4 colour, const std::uint8_t* end) {
    colour = colour > 255.0f ? f4{} + 255.0f : colour;
    colour = colour < 0.0f ? f4{} : colour;
    using u8x4 = std::uint8_t __attribute__((vector_size(4)));
    const u8x4 levels =
        __builtin_convertvector(__builtin_convertvector(colour + 0.5f, i4), u8x4);
    std::memcpy(to, &levels, to + 4 <= end ? 4 : 3);
}

void Scene::shade(std::uint8_t* rgb) {
    end_ = rgb + std::size_t(view_.last - view_.first) * lens_->width * 3;
    for (int y = view_.first; y < view_.last; ++y) {
        const std::size_t at = std::size_t(y - view_.first) * lens_->stride;
        std::uint8_t* row = rgb + std::size_t(y - view_.first) * lens_->width * 3;
        for (int left = 0, right; left < lens_->width; left = right) {
            const std::int32_t number = visible_[at + left];
            for (right = left + 1; right < lens_->width && visible_[at + right] == number;) ++right;
            if (number < 0)
                shade_sky(row, y, left, right);
            else
                shade_run(row, y, left, right, number);
        }
    }
}

void Scene::shade_run(std::uint8_t* row, int y, int left, int right, std::int32_t number) {
    const Surface& surface = this->surface(number);
    const Triangle& triangle = triangles_[number];
    const float* nearest = nearest_.data() + std::size_t(y - view_.first) * lens_->stride;
    f4 found[lanes];
    for (; left < right; left += lanes) {
        const int count = std::min(right - left, lanes);
        colours(surface, triangle, left, y, load(nearest + left), count, found);
        for (int k = 0; k < count; ++k) write(row + 3 * (left + k), found[k], end_);
    }
}

void Scene::shade_sky(std::uint8_t* row, int y, int left, int right) {
    for (int x = left; x < right; ++x) {
        f4 found{};
        const Vec3f along = ray(x, y);
        if (view_.sky >= 0 && along.x * along.x + along.y * along.y + along.z * along.z > 0) {
            const Vec3 world = view_.turn * Vec3{along.x, along.y, along.z};
            found = textures[view_.sky]->around({static_cast<float>(world.x),
                                                 static_cast<float>(world.z),
                                                 static_cast<float>(-world.y)}, 0) *
                    (1.0f / 256);
        }
        write(row + 3 * x, found, end_);
    }
}

// Whether a pixel on an edge is the triangle's, and not that of the one beyond.
bool Scene::owns(const Triangle& triangle, Vec3f ray) {
    for (const auto& edge : triangle.edges)
        if (times(edge, ray) == 0.0f && !(edge[0] > 0 || (edge[0] == 0 && edge[1] > 0)))
            return false;
    return true;
}

// Draw what is see-through over what is behind it, from the back to the front. It has a number, but
// no depth.
void Scene::blend(std::uint8_t* rgb) {
    if (!blended_.empty()) front_ = nearest_;
    for (const std::int32_t number : blended_) {
        const auto found = [&](int y, int x, i8 inside, f8 q) {
            const std::size_t at = std::size_t(y - view_.first) * lens_->stride + x;
            const i8 wins = inside & (q > load(&nearest_[at]));
            for (int k = 0; k < lanes && x + k < lens_->width; ++k) {
                if (!wins[k] || !owns(triangles_[number], ray(x + k, y))) continue;
                if (q[k] > front_[at + k]) front_[at + k] = q[k], visible_[at + k] = number;
                if (!rgb) continue;
                const Surface& surface = this->surface(number);
                f4 mine;
                colours(surface, triangles_[number], x + k, y, f8{} + q[k], 1, &mine);
                std::uint8_t* to =
                    rgb + (std::size_t(y - view_.first) * lens_->width + x + k) * 3;
                const f4 behind{float(to[0]), float(to[1]), float(to[2]), 0};
                write(to, behind + (mine - behind) * surface.opacity, to + 3);
            }
        };
        over(triangles_[number], found);
    }
}

}  // namespace raster

using namespace raster;

extern "C" {
#pragma GCC visibility push(default)

// Called by `raster.py`, which checks all sizes.

// Whether this machine has the instructions that this was compiled for.
int raster_runs() {
#ifdef __AVX2__
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") &&
           __builtin_cpu_supports("bmi2");
#else
    return 1;
#endif
}

Scene* raster_new() { return new Scene; }

void raster_free(Scene* scene) { delete scene; }

int raster_texture(Scene* scene, int width, int height, int channels, const std::uint8_t* data,
                   int cube) {
    scene->textures.push_back(std::make_unique<Texture>(width, height, channels, data, cube));
    return static_cast<int>(scene->textures.size()) - 1;
}

int raster_mesh(Scene* scene, int vertices, const float* points, const float* normals,
                const float* places, int triangles, const std::int32_t* corners) {
    auto mesh = std::make_unique<Mesh>();
    mesh->points.resize(vertices);
    mesh->normals.resize(vertices);
    std::memcpy(mesh->points.data(), points, sizeof(Vec3f) * vertices);
    std::memcpy(mesh->normals.data(), normals, sizeof(Vec3f) * vertices);
    mesh->places.assign(places, places + 2 * vertices);
    mesh->corners.assign(corners, corners + 3 * triangles);
    Vec3f low{1e30f, 1e30f, 1e30f}, high{-1e30f, -1e30f, -1e30f};
    for (const Vec3f& p : mesh->points) {
        low = {std::min(low.x, p.x), std::min(low.y, p.y), std::min(low.z, p.z)};
        high = {std::max(high.x, p.x), std::max(high.y, p.y), std::max(high.z, p.z)};
    }
    mesh->middle = (low + high) * 0.5f;
    mesh->reach = (high - low) * 0.5f;
    scene->meshes.push_back(std::move(mesh));
    return static_cast<int>(scene->meshes.size()) - 1;
}

// Rays of a pinhole (x of each column, y of each row, z null) or of each pixel (NaN: none).
int raster_lens(Scene* scene, int width, int height, const float* x, const float* y,
                const float* z) {
    auto lens = std::make_unique<Lens>();
    lens->pinhole = z == nullptr;
    lens->width = width;
    lens->height = height;
    lens->stride = (width + lanes - 1) / lanes * lanes;
    const float none = std::numeric_limits<float>::quiet_NaN();
    if (lens->pinhole) {
        lens->x.assign(lens->stride + lanes, none);
        std::copy(x, x + width, lens->x.begin());
        lens->y.assign(y, y + height);
        lens->pitch[0] = width > 1 ? x[1] - x[0] : 1.0f;
        lens->pitch[1] = height > 1 ? y[1] - y[0] : 1.0f;
    } else {
        for (auto [to, from] : {std::pair{&lens->x, x}, std::pair{&lens->y, y},
                                std::pair{&lens->z, z}}) {
            to->assign(std::size_t(lens->stride) * height + lanes, 0.0f);  // hits nothing
            for (int row = 0; row < height; ++row)
                for (int column = 0; column < width; ++column) {
                    const float value = from[std::size_t(row) * width + column];
                    if (value == value) (*to)[std::size_t(row) * lens->stride + column] = value;
                }
        }
        lens->coarse.side = 64, lens->fine.side = 16;
        for (Lens::Grid* grid : {&lens->coarse, &lens->fine}) {
            grid->across = (width + grid->side - 1) / grid->side;
            const int down = (height + grid->side - 1) / grid->side;
            grid->boxes.assign(std::size_t(grid->across) * down, {{2, 2, 2}, {-2, -2, -2}});
            for (int row = 0; row < height; ++row)
                for (int column = 0; column < width; ++column) {
                    const std::size_t at = std::size_t(row) * lens->stride + column;
                    Lens::Box& box = grid->boxes[std::size_t(row / grid->side) * grid->across +
                                                 column / grid->side];
                    const float ray[3] = {lens->x[at], lens->y[at], lens->z[at]};
                    if (ray[0] == 0 && ray[1] == 0 && ray[2] == 0) continue;
                    for (int k = 0; k < 3; ++k) {
                        box.low[k] = std::min(box.low[k], ray[k]);
                        box.high[k] = std::max(box.high[k], ray[k]);
                    }
                }
        }
    }
    scene->lenses.push_back(std::move(lens));
    return static_cast<int>(scene->lenses.size()) - 1;
}

// Images not wanted are null.
void raster_draw(Scene* scene, int lens, const View* view, int geoms, const Geom* geom, int lights,
                 const Light* light, std::uint8_t* rgb, float* depth, std::int32_t* numbers) {
    scene->draw(*scene->lenses[lens], *view, geom, geoms, light, lights, rgb, depth, numbers);
}

#pragma GCC visibility pop
}  // extern "C"
