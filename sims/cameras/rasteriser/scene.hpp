// What is drawn, and how far the drawing of a frame has come.
#pragma once

#include <memory>
#include <vector>

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
    Vec3 shift;                    // of its mesh's origin from the eye, in the optical frame
    Matrix turn;                   // from the mesh's axes to the optical frame
    std::vector<Vec3> seen;        // its vertices in the optical frame
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

    void measure(float* depth) const;
    void number(std::int32_t* numbers) const;
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

}  // namespace raster
