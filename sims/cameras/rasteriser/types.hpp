// Types of the rasteriser: short vectors, and what the caller describes a scene with.
//
// All arithmetic is IEEE 754 without contraction, and no function of the C library is called that
// may round differently elsewhere: the same scene gives the same bytes on every machine.
#pragma once

#include <cstdint>
#include <cstring>
#include <memory>
#include <vector>

namespace raster {

using f8 = float __attribute__((vector_size(32)));
using i8 = std::int32_t __attribute__((vector_size(32)));
constexpr int lanes = 8;

inline f8 load(const float* from) {
    f8 found;
    std::memcpy(&found, from, sizeof found);
    return found;
}
inline void store(float* to, f8 value) { std::memcpy(to, &value, sizeof value); }
inline i8 load(const std::int32_t* from) {
    i8 found;
    std::memcpy(&found, from, sizeof found);
    return found;
}
inline void store(std::int32_t* to, i8 value) { std::memcpy(to, &value, sizeof value); }

template <typename T>
struct Vec {
    T x, y, z;
};
using Vec3 = Vec<double>;
using Vec3f = Vec<float>;

template <typename T>
inline Vec<T> operator+(Vec<T> a, Vec<T> b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
template <typename T>
inline Vec<T> operator-(Vec<T> a, Vec<T> b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
template <typename T>
inline Vec<T> operator*(Vec<T> a, T k) { return {a.x * k, a.y * k, a.z * k}; }
template <typename T>
inline T dot(Vec<T> a, Vec<T> b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
template <typename T>
inline Vec<T> cross(Vec<T> a, Vec<T> b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
inline Vec3f narrow(Vec3 a) {
    return {static_cast<float>(a.x), static_cast<float>(a.y), static_cast<float>(a.z)};
}

struct Matrix {  // 3 x 3, row by row
    double m[9];
    Vec3 operator*(Vec3 a) const {
        return {m[0] * a.x + m[1] * a.y + m[2] * a.z, m[3] * a.x + m[4] * a.y + m[5] * a.z,
                m[6] * a.x + m[7] * a.y + m[8] * a.z};
    }
    Vec3 back(Vec3 a) const {  // by the transpose
        return {m[0] * a.x + m[3] * a.y + m[6] * a.z, m[1] * a.x + m[4] * a.y + m[7] * a.z,
                m[2] * a.x + m[5] * a.y + m[8] * a.z};
    }
};

// The following have the layout of NumPy's structured arrays in `raster.py`.

struct Geom {
    std::int32_t mesh, texture;  // numbers of theirs; texture -1 for none
    std::int32_t number;         // in the image of numbers
    std::int32_t culled;         // whether it is seen from the front only
    float rgba[4];
    float emission, specular, shininess;
    float repeat[2], offset;  // of the places in the texture
    float cube[3], unused;    // times a point of the mesh: its direction in a cube of textures
    double position[3];  // in the world, metres
    Matrix turn;         // from the mesh's axes to the world's
};

struct Light {
    std::int32_t kind, unused;  // 0 directional, 1 point, 2 spot
    float ambient[3], diffuse[3], specular[3], attenuation[3];
    float cutoff, exponent;  // cosine of the cone's half angle
    double position[3], direction[3];
};

struct View {
    double position[3];  // of the eye in the world, metres
    Matrix turn;         // from the optical frame (x right, y down, z ahead) to the world
    std::int32_t width, height, first, last;  // rows to draw: first to last - 1
    std::int32_t sky, fogged;                 // number of the sky's texture, or -1
    float near, far;                          // nothing nearer is drawn; depth beyond is inf
    float fog[3], fog_start, fog_end, unused;
};

}  // namespace raster
