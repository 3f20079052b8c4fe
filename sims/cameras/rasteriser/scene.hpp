// What is drawn, and how far the drawing of a frame has come.
#pragma once

#include <algorithm>
#include <functional>
#include <map>
#include <memory>
#include <vector>

#include "texture.hpp"
#include "types.hpp"

namespace raster {

struct Bounds {
    Vec3f middle, reach;

    template <typename Point>
    static Bounds about(int count, Point point) {
        Vec3f low{1e30f, 1e30f, 1e30f}, high{-1e30f, -1e30f, -1e30f};
        for (int k = 0; k < count; ++k) {
            const Vec3f p = point(k);
            low = {std::min(low.x, p.x), std::min(low.y, p.y), std::min(low.z, p.z)};
            high = {std::max(high.x, p.x), std::max(high.y, p.y), std::max(high.z, p.z)};
        }
        return {(low + high) * 0.5f, (high - low) * 0.5f};
    }
};

// Neighbouring triangles of a mesh, which are left out together where none is seen.
struct Cluster {
    static constexpr int most = 64;
    Bounds bounds;
    Vec3f axis;  // of a cone about their normals,
    float sine;  // of its half angle; more than 1 if they face all ways
};

// Elements that the caller keeps, as long as the scene refers to them.
template <typename T>
struct Span {
    const T* first = nullptr;
    std::size_t count = 0;

    const T& operator[](std::size_t k) const { return first[k]; }
    const T* data() const { return first; }
    std::size_t size() const { return count; }
    bool empty() const { return count == 0; }
};

struct Mesh {
    Span<Vec3f> points, normals;
    Span<float> places;          // in a texture, u and v of each vertex
    Span<float> colours;         // factors of each vertex: red, green, blue, opacity; or none
    Span<std::int32_t> corners;  // three of each triangle, counterclockwise from outside
    Span<std::int32_t> parts;    // of each triangle: number of the surface without a crease
    int part_count = 0;
    Span<std::int32_t> beyond;   // of each edge: first corner of the triangle on the other side
                                 // that belongs to the same part, or -1

    Bounds bounds;
    Span<Cluster> clusters;      // of so many triangles each; none of a small mesh

    // Of its points, normals and corners: `parts`, whose count is returned, and `beyond`.
    int find_parts(std::int32_t* to_parts, std::int32_t* to_beyond) const;
    static int cluster_count(int triangles) {
        return triangles > 2 * Cluster::most ? (triangles + Cluster::most - 1) / Cluster::most : 0;
    }
    void find_clusters(Cluster* to) const;
};

// Rays of all pixels: of a pinhole x by column and y by row, else all by pixel.
struct Lens {
    const bool pinhole;
    const int width, height, stride;
    double step[2]{};  // of a pinhole: a pixel's width and height at z = 1
    double per_step[2]{};
    bool is_precise = false;  // whether it is certain to 1/400 pixel on which side of an edge a ray is
    std::vector<float> x, y, z;

    // Squares of pixels, and of each the four smaller ones in it, with boxes about their rays.
    struct Square {
        f4 low[3], high[3];     // low above high: no rays
        std::int32_t parts[4];  // numbers of squares, below 0 for pixels
    };
    static constexpr int smallest = 8, small = 64;  // sides, pixels
    int largest = smallest;  // the root's side, twice that of its parts
    std::vector<Square> squares;

    // Number of the square of such a side about a pixel; -1 for none.
    std::int32_t square(int side, int column, int row) const {
        const int level = __builtin_ctz(side / (2 * smallest));
        return by_level_[level][std::size_t(row / side) * (largest / side) + column / side];
    }

    // Where the ray in a direction is, pixels, nearly, column -1 if that is not known; of a pinhole
    // x and y at z = 1, not a number behind it.
    struct Pixel {
        double column, row;
    };
    Pixel pixel(Vec3 towards) const {
        if (!pinhole) return near_pixel(towards);
        const double share = towards.z > 0 ? 1.0 / towards.z : std::nan("");
        return {towards.x * share, towards.y * share};
    }

    float bend = 0;  // how far an edge may bulge, pixels, by the square of its triangle's sine

    Lens(int width, int height, const float* x, const float* y, const float* z);

    Vec3f ray(int column, int row) const {
        if (pinhole) return {x[column], y[row], 1.0f};
        const std::size_t at = std::size_t(row) * stride + column;
        return {x[at], y[at], z[at]};
    }

  private:
    struct Spot {  // a pixel with a ray in about some direction; column -1 for none
        std::int16_t column, row;
    };
    static constexpr int spots_across = 256;

    Pixel near_pixel(Vec3 towards) const;
    int cut(int column, int row, int side);
    void find_spots();
    static std::size_t spot(Vec3f direction);

    std::vector<std::vector<std::int32_t>> by_level_;  // squares of 16 pixels, 32 and so on
    std::vector<Spot> spots_;
};

// The planes through the eye and the edges of a triangle, a lane each, and how far it faces away.
struct Corners {
    d4 x, y, z;  // the last lane of x is how far

    explicit Corners(const Vec3 (&points)[3]) {
        const Vec3 a = cross(points[0], points[1]), b = cross(points[1], points[2]);
        const Vec3 c = cross(points[2], points[0]);
        const double away = dot(cross(points[1] - points[0], points[2] - points[0]), points[0]);
        x = d4{a.x, b.x, c.x, away}, y = d4{a.y, b.y, c.y, 0}, z = d4{a.z, b.z, c.z, 0};
    }

    // Between two poses: all of these are linear in the eye's place.
    Corners(const Corners& from, const Corners& to, double share)
        : x(from.x + (to.x - from.x) * share), y(from.y + (to.y - from.y) * share),
          z(from.z + (to.z - from.z) * share) {}

    double away() const { return x[3]; }
    d4 edge(int k) const { return d4{x[k], y[k], z[k], 0}; }
};

// The most that a plane may say of the rays in each part of a square.
inline f4 most(const Lens::Square& rays, Vec3f plane) {
    return (plane.x > 0 ? rays.high : rays.low)[0] * plane.x +
           ((plane.y > 0 ? rays.high : rays.low)[1] * plane.y +
            (plane.z > 0 ? rays.high : rays.low)[2] * plane.z);
}

// What the planes of a triangle say of a ray: of three edges, positive inside, and its inverse depth.
struct Planes {
    f4 x, y, z;

    Planes() = default;
    explicit Planes(const Corners& of) {
        const double share = inverse(of.away()), side = of.away() > 0 ? 1.0 : -1.0;
        const auto planes = [=](d4 edges) {
            d4 found = edges * side;
            found[3] = (edges[0] + edges[1] + edges[2]) * share;
            return __builtin_convertvector(found, f4);
        };
        x = planes(of.x), y = planes(of.y), z = planes(of.z);
    }

    f4 operator()(Vec3f ray) const { return x * ray.x + (y * ray.y + z * ray.z); }
    Vec3f operator[](int k) const { return {x[k], y[k], z[k]}; }
    Vec3f depth() const { return (*this)[3]; }
};

struct Triangle {
    Planes planes;
    std::int32_t geom, corner, part;  // its parts count on from geom to geom
    int left, right, top, bottom;  // pixels that it may cover: to right - 1 and bottom - 1
    Vec3f ahead;                   // towards the ball about it, and the least cosine of rays to it
    float least;
    bool behind;                   // whether it is seen from there
};

struct Moving {  // a triangle that is seen from one pose in its first row, and another in its last
    Corners from, to;
};

struct Shade {  // of a light that throws shadows, on a triangle: all but `depth` times the ray
    bool shines;
    float light[3][3];
    float place[3][3];  // seen from the light
    float depth[3];     // inverse depth, times a ray of the light's
    std::uint32_t spread;  // where the tiles are that are known of it, in a table
};

constexpr int all_lit = 1, all_dark = 2;

struct Area {  // of a light's map, pixels; state 0 if it is not known
    int state;
    float left, right, top, bottom;
};

struct Tile {  // of a light's map, as the plane of a triangle sees it
    std::int32_t caster = -1, place;
    std::uint32_t change;
    float depth[3];  // of the plane
    int state;
};

struct Surface {  // what is interpolated on a triangle, each times the ray
    float depth[3];
    float u[3], v[3], w[3];  // w of a cube, in which they are a direction
    float light[3][3];
    std::int32_t shades;  // number of the first
    std::int32_t part, number;  // of its triangle and its geom
    bool flat;
    std::uint16_t same[3];  // the light of a flat one, in 65536ths
    const Texture* texture;
    float width, height;  // of its finest level, texels
    float opacity;
};

struct Placed {  // a geom of the frame
    const Geom* geom;
    const Mesh* mesh;
    Vec3 shift;                    // of its mesh's origin from the eye, in the optical frame
    Matrix turn;                   // from the mesh's axes to the optical frame
    std::int32_t parts;            // how many those before it have
    std::vector<std::int32_t> listed;  // of each of its triangles, unless all moves: the number in
                                       // `list`, or one of the following
    static constexpr std::int32_t faces_away = -1, out_of_view = -2;
    const std::vector<Triangle>* list;
    bool is_seen;                  // whether the following are known
    std::vector<Vec3> seen;        // its vertices in the optical frame
    std::vector<Lens::Pixel> pixels;  // and in the image
    const float* thresholds;       // of opacity, for sizes of its texture; null without a cutoff
    int sizes;
    int square, column, row, side;  // the smallest of the lens's squares about it, if it has any
};

// Images to fill; those not wanted are null.
struct Images {
    std::uint8_t* rgb;
    float* depth;
    std::int32_t* numbers;
};

// What a band finds out, for the next frame; and what it fills anew in each, which stays allocated.
struct Memory {
    std::vector<Surface> surfaces;
    std::vector<Shade> shades;
    std::vector<std::vector<std::int32_t>> surface_of;
    std::vector<Tile> tiles;  // known of lights' maps
};

class Scene {
  public:
    std::vector<std::unique_ptr<Mesh>> meshes;
    std::vector<std::unique_ptr<Texture>> textures;
    std::vector<std::unique_ptr<Lens>> lenses;
    const std::uint32_t* texels = nullptr;  // two white ones, and all textures'; the caller keeps them

    // Eyes and poses are `view.poses` times those of one pose: the first are of the uppermost row of
    // the image, the last of the lowest one, and the others between at equal steps.
    void draw(const Lens& lens, const View& view, const Pose* eyes, const Geom* geoms,
              const Pose* poses, int count, const Light* lights, int light_count,
              const Images& images);

    // Lay some geoms that move over a light's map of those that stand still: depths, by row. Of all
    // geoms, `covered` says where the map is not `still`, before and then.
    void shadow(const Lens& lens, float near, const Pose& eye, const Geom* geoms, const Pose* poses,
                int count, const std::int32_t* moving, int moving_count, const float* still,
                float* map, std::uint32_t* changes, Box* covered);

  private:
    friend class Band;

    struct Slot {  // light on a geom's vertices, and then that of each light that throws shadows;
                   // and after it, if it is double-sided, all of this on their other sides
        Geom geom;
        Pose pose;
        int frame;
        std::vector<Vec3f> light;  // none while it moves
    };
    using Triangles = std::vector<std::vector<Triangle>>;
    using Movings = std::vector<std::vector<Moving>>;

    void draw_rows(int first, int last, const Geom* geoms, const Pose* poses, int count,
                   const Images& images, bool fresh);
    void place(const Geom& geom, const Pose& pose, const Pose& eye, Placed& placed);
    void cut(Placed& placed);
    static bool is_solid(const Geom& geom) { return geom.rgba[3] >= 1.0f || geom.cutoff > 0; }
    void see(Placed& placed) const;
    int beyond(const Placed& placed, const Bounds& bounds) const;
    bool hidden(const Placed& placed, const Bounds& bounds) const;
    std::int32_t unseen(const Placed& placed, const Cluster& cluster) const;
    std::size_t tile(int x, int y) const {  // number of the square about a pixel of these rows
        return std::size_t(y / Lens::smallest - first_ / Lens::smallest) *
                   (lens_->stride / Lens::smallest) + x / Lens::smallest;
    }
    static double ball(Vec3 middle, double reach, Vec3f& ahead, float& least);
    bool in_squares(Placed& placed, const Placed& later) const;
    void add(int index, std::vector<Triangle>& to, std::vector<Moving>& moving);
    bool bounded(Triangle& triangle, const Vec3* points, const Lens::Pixel* pixels, int count,
                 bool turns) const;
    bool tightly_bounded(Triangle& triangle, const Lens::Pixel* pixels) const;
    void light(const Geom& geom, const Pose& pose, Slot& slot) const;
    void light(const Slot& slot, int vertex, bool behind, Vec3f* to, std::size_t apart) const;
    void spread(int parts, const std::function<void(int)>& work) const;

    const Lens* lens_ = nullptr;
    View view_{};
    int frame_ = 0;
    int first_ = 0, last_ = 0;  // rows that are being drawn: first to last - 1
    double start_ = 0, step_ = 0;  // row of the first pose, and how many there are to the next one
    int passed_ = 0;  // how many poses since that of the rows before these
    Pose eye_{}, next_eye_{}, middle_eye_{};
    const Pose* middle_poses_ = nullptr;  // of geoms; their light is that of all rows
    std::vector<Light> lights_;
    std::vector<Light> casters_;  // those that throw shadows
    std::map<std::pair<std::int32_t, float>, std::vector<float>> thresholds_;  // by texture
    std::vector<Placed> placed_, later_;  // for the first pose, and the next one
    std::vector<Slot> slots_;
    Triangles solid_, clear_;  // of these rows, in parts
    Movings solid_moving_, clear_moving_;
    std::vector<Triangle> before_;  // solid ones of the rows before these, while all moves
    std::vector<Moving> before_moving_;
    std::vector<Memory> memory_;  // of each band
    bool hides_ = false;         // whether what is drawn so far may hide something
    std::vector<float> hiding_;  // least inverse depth in each square of pixels, of a pinhole
    std::vector<float> nearest_;         // inverse depth of the nearest surface; 0 for nothing
    std::vector<std::int32_t> visible_;  // its triangle
};

}  // namespace raster
