// A rasteriser of textured triangles: colour, depth and object numbers of one visibility buffer.
//
// Every pixel has a ray; a triangle, seen from the eye, is three planes through its edges, and its
// inverse depth and all that is interpolated on it are linear in the ray (M. Olano, T. Greer,
// "Triangle Scan Conversion using 2D Homogeneous Coordinates", Graphics Hardware 1997). So nothing
// is clipped, and any lens is drawn directly. First each pixel learns which triangle is nearest;
// then runs of pixels of one triangle are shaded together.
#include <algorithm>
#include <limits>

#include "scene.hpp"

using namespace raster;

extern "C" {
#pragma GCC visibility push(default)

// Called by `raster.py`, which checks all sizes.

// Whether this machine has the instructions that this was compiled for.
int raster_runs() {
#ifdef __AVX2__
    return __builtin_cpu_supports("avx2");
#elif defined(__SSE4_1__)
    return __builtin_cpu_supports("sse4.1");
#else
    return 1;
#endif
}

Scene* raster_new() { return new Scene; }

void raster_free(Scene* scene) { delete scene; }

// -1 if there is no room for it: all texels have a number.
int raster_texture(Scene* scene, int width, int height, int channels, const std::uint8_t* data,
                   int cube) {
    const auto before = static_cast<std::int64_t>(scene->texels.size());
    if (before + Texture::count(width, height, cube) > std::numeric_limits<std::int32_t>::max())
        return -1;
    scene->textures.push_back(std::make_unique<Texture>(
        scene->texels, width, height, channels, data, cube));
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
    mesh->bounds = Bounds::about(vertices, [&](int k) { return mesh->points[k]; });
    mesh->find_parts();
    mesh->find_clusters();
    scene->meshes.push_back(std::move(mesh));
    return static_cast<int>(scene->meshes.size()) - 1;
}

// Factors on the colour of each vertex of a mesh: red, green, blue, opacity.
void raster_colours(Scene* scene, int mesh, const float* colours) {
    std::vector<float>& to = scene->meshes[mesh]->colours;
    to.assign(colours, colours + 4 * scene->meshes[mesh]->points.size());
}

// Rays of a pinhole (x of each column, y of each row, z null) or of each pixel (NaN: none).
int raster_lens(Scene* scene, int width, int height, const float* x, const float* y,
                const float* z) {
    scene->lenses.push_back(std::make_unique<Lens>(width, height, x, y, z));
    return static_cast<int>(scene->lenses.size()) - 1;
}

// Images not wanted are null; eyes and poses as `Scene::draw` takes them.
void raster_draw(Scene* scene, int lens, const View* view, const Pose* eyes, int geoms,
                 const Geom* geom, const Pose* poses, int lights, const Light* light,
                 std::uint8_t* rgb, float* depth, std::int32_t* numbers) {
    scene->draw(*scene->lenses[lens], *view, eyes, geom, poses, geoms, light, lights,
                {rgb, depth, numbers});
}

// Lay moving geoms over a shadow map, as `Scene::shadow` does it. After the map's pixels there are
// as many as a vector has, which are written as they are.
void raster_shadow(Scene* scene, int lens, float near, const Pose* eye, int geoms, const Geom* geom,
                   const Pose* poses, int moving_count, const std::int32_t* moving,
                   const float* still, float* map, std::uint32_t* changes, Box* covered) {
    scene->shadow(*scene->lenses[lens], near, *eye, geom, poses, geoms, moving, moving_count, still,
                  map, changes, covered);
}

#pragma GCC visibility pop
}  // extern "C"
