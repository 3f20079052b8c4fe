// Calls the library as a recording says (`test_other_processors.py`), and writes images and hits.
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <vector>

extern "C" {
void* raster_new();
int raster_texture(void*, int, int, int, const void*, int);
int raster_mesh(void*, int, const void*, const void*, const void*, int, const void*);
int raster_lens(void*, int, int, const void*, const void*, const void*);
void raster_draw(void*, int, const void*, const void*, int, const void*, const void*, int,
                 const void*, void*, void*, void*);
void* rays_new();
int rays_mesh(void*, int, const void*, int, const void*);
void rays_build(void*, int, const void*, const void*, const void*, const void*, const void*);
void rays_cast(void*, const void*, const void*, const void*, const void*, int, const void*, void*,
               void*, void*, void*);
}

static std::int32_t number() {
    std::int32_t found;
    if (std::fread(&found, sizeof found, 1, stdin) != 1) std::exit(0);  // the recording's end
    return found;
}

static std::vector<char> bytes() {  // their count, and they; kept, as the scene may point to them
    std::vector<char> found(number());
    if (std::fread(found.data(), 1, found.size(), stdin) != found.size()) std::exit(1);
    return found;
}

int main() {
    void* scene = raster_new();
    void* trees = nullptr;
    for (;;) {
        switch (number()) {
            case 0: {
                const int width = number(), height = number(), channels = number(), cube = number();
                raster_texture(scene, width, height, channels, bytes().data(), cube);
                break;
            }
            case 1: {
                const int vertices = number(), triangles = number();
                const auto points = bytes(), normals = bytes(), places = bytes(), corners = bytes();
                raster_mesh(scene, vertices, points.data(), normals.data(), places.data(), triangles,
                            corners.data());
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
