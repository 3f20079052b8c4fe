// Calls the library as a recording says (`test_other_processors.py`), and writes images and hits.
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <list>
#include <vector>

extern "C" {
void* raster_new();
std::int64_t raster_texel_count(int, int, int);
void raster_fill(std::uint32_t*, int, int, int, const void*, int);
void raster_texels(void*, const void*);
int raster_texture(void*, int, int, int, int, int);
int raster_cluster_count(int);
int raster_find(int, const void*, const void*, int, const void*, void*, void*, void*);
int raster_mesh(void*, int, const void*, const void*, const void*, const void*, int, const void*,
                const void*, int, const void*, const void*);
int raster_lens(void*, int, int, const void*, const void*, const void*);
void raster_draw(void*, int, const void*, const void*, int, const void*, const void*, int,
                 const void*, void*, void*, void*);
void* rays_new();
int rays_mesh(void*, int, const void*, int, const void*);
void rays_build(void*, int, const void*, const void*, const void*, const void*, const void*);
void rays_cast(void*, const void*, const void*, const void*, const void*, int, const void*, void*,
               void*, void*, void*);
}

constexpr int cluster_size = 40;  // bytes, as in `layouts.py`

static std::int32_t number() {
    std::int32_t found;
    if (std::fread(&found, sizeof found, 1, stdin) != 1) std::exit(0);  // the recording's end
    return found;
}

static std::vector<char> bytes() {  // their count, and they
    std::vector<char> found(number());
    if (std::fread(found.data(), 1, found.size(), stdin) != found.size()) std::exit(1);
    return found;
}

int main() {
    void* scene = raster_new();
    void* trees = nullptr;
    std::vector<std::uint32_t> texels{0xffffff, 0xffffff};  // the scene points to them
    std::list<std::vector<char>> meshes;                    // and to these
    const auto lasting = [&](std::vector<char> part) { return meshes.emplace_back(part).data(); };
    for (;;) {
        switch (number()) {
            case 0: {
                const int width = number(), height = number(), channels = number(), cube = number();
                const auto start = texels.size();
                texels.resize(start + raster_texel_count(width, height, cube));
                raster_fill(&texels[start], width, height, channels, bytes().data(), cube);
                raster_texels(scene, texels.data());
                break;
            }
            case 1: {
                const int vertices = number(), triangles = number();
                const char *points = lasting(bytes()), *normals = lasting(bytes());
                const char* places = lasting(bytes());
                const auto factors = bytes();
                const char* colours = factors.empty() ? nullptr : lasting(factors);
                const char* corners = lasting(bytes());
                char* parts = lasting(std::vector<char>(4 * triangles));
                char* beyond = lasting(std::vector<char>(12 * triangles));
                char* clusters =
                    lasting(std::vector<char>(cluster_size * raster_cluster_count(triangles)));
                const int count = raster_find(vertices, points, normals, triangles, corners, parts,
                                              beyond, clusters);
                raster_mesh(scene, vertices, points, normals, places, colours, triangles,
                            corners, parts, count, beyond, clusters);
                break;
            }
            case 7: {
                const int start = number(), width = number(), height = number();
                const int channels = number(), cube = number();
                raster_texture(scene, start, width, height, channels, cube);
                break;
            }
            case 2: {
                const int width = number(), height = number();
                const auto x = bytes(), y = bytes(), z = bytes();
                raster_lens(scene, width, height, x.data(), y.data(), z.empty() ? nullptr : z.data());
                break;
            }
            case 3: {
                const int lens = number(), geoms = number(), lights = number(), pixels = number();
                const auto view = bytes(), eyes = bytes(), geom = bytes(), poses = bytes();
                const auto light = bytes();
                std::vector<char> rgb(3 * pixels), depth(4 * pixels), numbers(4 * pixels);
                raster_draw(scene, lens, view.data(), eyes.data(), geoms, geom.data(), poses.data(),
                            lights, light.data(), rgb.data(), depth.data(), numbers.data());
                for (const auto* image : {&rgb, &depth, &numbers})
                    std::fwrite(image->data(), 1, image->size(), stdout);
                break;
            }
            case 4: {
                const int vertices = number(), triangles = number();
                const auto points = bytes(), corners = bytes();
                trees = rays_new();
                rays_mesh(trees, vertices, points.data(), triangles, corners.data());
                break;
            }
            case 5: {
                const int geoms = number();
                const auto numbers = bytes(), meshes = bytes(), moves = bytes();
                const auto positions = bytes(), turns = bytes();
                rays_build(trees, geoms, numbers.data(), meshes.data(), moves.data(),
                           positions.data(), turns.data());
                break;
            }
            case 6: {
                const int rays = number();
                const auto positions = bytes(), turns = bytes(), wanted = bytes();
                const auto origin = bytes(), directions = bytes();
                auto distances = bytes(), geoms = bytes();
                std::vector<char> normals(24 * rays), triangles(4 * rays);
                rays_cast(trees, positions.data(), turns.data(), wanted.data(), origin.data(), rays,
                          directions.data(), distances.data(), geoms.data(), normals.data(),
                          triangles.data());
                for (const auto* part : {&distances, &geoms, &normals, &triangles})
                    std::fwrite(part->data(), 1, part->size(), stdout);
            }
        }
    }
}
