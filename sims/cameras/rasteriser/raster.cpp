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

static Mesh shape_of(int vertices, const float* points, const float* normals, int triangles,
                     const std::int32_t* corners) {
    Mesh mesh;
    const auto count = std::size_t(vertices);
    mesh.points = {reinterpret_cast<const Vec3f*>(points), count};
    mesh.normals = {reinterpret_cast<const Vec3f*>(normals), count};
    mesh.corners = {corners, 3 * std::size_t(triangles)};
    return mesh;
}

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

// How many texels a texture takes, with all of its sizes.
std::int64_t raster_texel_count(int width, int height, int cube) {
    return Texture::count(width, height, cube);
}

// Write as many: an image in all of its sizes.
void raster_fill(std::uint32_t* to, int width, int height, int channels, const std::uint8_t* data,
                 int cube) {
    Texture::fill(to, width, height, channels, data, cube);
}

// Texels of all textures, after two white ones. Like all arrays from here on, the caller keeps them
// as long as the scene is there, unchanged: several scenes, also of several processes, may share them.
void raster_texels(Scene* scene, const std::uint32_t* texels) { scene->texels = texels; }

// A texture of so many columns and rows, whose texels begin at `start` among all.
int raster_texture(Scene* scene, int start, int width, int height, int channels, int cube) {
    scene->textures.push_back(std::make_unique<Texture>(start, width, height, channels, cube));
    return static_cast<int>(scene->textures.size()) - 1;
}

int raster_cluster_count(int triangles) { return Mesh::cluster_count(triangles); }

// Find what `raster_mesh` takes of a mesh: the part of each triangle, the triangle beyond each of
// its edges, and clusters. Returned is the number of parts.
int raster_find(int vertices, const float* points, const float* normals, int triangles,
                const std::int32_t* corners, std::int32_t* parts, std::int32_t* beyond,
                Cluster* clusters) {
    const Mesh mesh = shape_of(vertices, points, normals, triangles, corners);
    mesh.find_clusters(clusters);
    return mesh.find_parts(parts, beyond);
}

// A mesh; colours are factors on the colour of each vertex (red, green, blue, opacity), or null.
int raster_mesh(Scene* scene, int vertices, const float* points, const float* normals,
                const float* places, const float* colours, int triangles,
                const std::int32_t* corners, const std::int32_t* parts, int part_count,
                const std::int32_t* beyond, const Cluster* clusters) {
    Mesh mesh = shape_of(vertices, points, normals, triangles, corners);
    mesh.places = {places, 2 * std::size_t(vertices)};
    if (colours) mesh.colours = {colours, 4 * std::size_t(vertices)};
    mesh.parts = {parts, std::size_t(triangles)}, mesh.part_count = part_count;
    mesh.beyond = {beyond, 3 * std::size_t(triangles)};
    mesh.clusters = {clusters, std::size_t(Mesh::cluster_count(triangles))};
    mesh.bounds = Bounds::about(vertices, [&](int k) { return mesh.points[k]; });
    scene->meshes.push_back(std::make_unique<Mesh>(mesh));
    return static_cast<int>(scene->meshes.size()) - 1;
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
