// Types of the rasteriser: short vectors, and what the caller describes a scene with.
//
// All arithmetic is IEEE 754 without contraction, and no function of the C library is called that
// may round differently elsewhere: the same scene gives the same bytes on every machine.
#pragma once

#ifdef __SSE2__
#include <immintrin.h>
#endif

#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <memory>
#include <vector>

namespace raster {

#ifdef __AVX2__
constexpr int lanes = 8;
#else
constexpr int lanes = 4;
#endif
constexpr int widest = 8;  // of all machines: buffers have room for it
constexpr int width_of_vectors = 4 * lanes;
using fv = float __attribute__((vector_size(width_of_vectors)));
using iv = std::int32_t __attribute__((vector_size(width_of_vectors)));
using wv = std::uint16_t __attribute__((vector_size(width_of_vectors)));  // two in each lane
using f4 = float __attribute__((vector_size(16)));
using d4 = double __attribute__((vector_size(32)));
using i4 = std::int32_t __attribute__((vector_size(16)));
using qv = std::uint64_t __attribute__((vector_size(width_of_vectors)));

// Lanes of two vectors, by their numbers.
#ifdef __clang__
#define RASTER_SHUFFLE(type, a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else  // GCC has the other one since version 12 only
#define RASTER_SHUFFLE(type, a, b, ...) __builtin_shuffle(a, b, type{__VA_ARGS__})
#endif

template <typename V, typename T>
inline V load(const T* from) {
    V found;
    std::memcpy(&found, from, sizeof found);
    return found;
}
template <typename V, typename T>
inline void store(T* to, V value) { std::memcpy(to, &value, sizeof value); }

inline fv as_float(iv value) { return __builtin_convertvector(value, fv); }

// Towards 0. It must fit: what does not becomes another number on another processor.
inline iv as_whole(fv value) {
#ifdef RASTER_CHECKED  // sanitizers look at scalars only
    iv found{};
    for (int k = 0; k < lanes; ++k) found[k] = static_cast<std::int32_t>(value[k]);
    return found;
#else
    return __builtin_convertvector(value, iv);
#endif
}
inline bool any(iv mask) {  // whether a lane is not 0
#if defined(__AVX2__)
    const auto bits = reinterpret_cast<__m256i>(mask);
    return !_mm256_testz_si256(bits, bits);
#elif defined(__SSE4_1__)
    const auto bits = reinterpret_cast<__m128i>(mask);
    return !_mm_testz_si128(bits, bits);
#else
    std::int32_t found = 0;
    for (int k = 0; k < lanes; ++k) found |= mask[k];
    return found;
#endif
}
inline int bits(i4 mask) {  // one for each lane
#ifdef __SSE2__
    return _mm_movemask_ps(reinterpret_cast<__m128>(mask));
#else
    return (mask[0] & 1) | (mask[1] & 2) | (mask[2] & 4) | (mask[3] & 8);
#endif
}
#ifdef __AVX2__
inline int bits(iv mask) { return _mm256_movemask_ps(reinterpret_cast<__m256>(mask)); }
#endif
inline fv floored(fv value) {  // of any size
#if defined(__AVX2__)
    return reinterpret_cast<fv>(_mm256_floor_ps(reinterpret_cast<__m256>(value)));
#elif defined(__SSE4_1__)
    return reinterpret_cast<fv>(_mm_floor_ps(reinterpret_cast<__m128>(value)));
#else
    for (int k = 0; k < lanes; ++k) value[k] = std::floor(value[k]);
    return value;
#endif
}

// The upper halves of the products.
inline wv high(wv a, wv b) {
#if defined(__AVX2__)
    return reinterpret_cast<wv>(_mm256_mulhi_epu16(reinterpret_cast<__m256i>(a),
                                                   reinterpret_cast<__m256i>(b)));
#elif defined(__SSE2__)
    return reinterpret_cast<wv>(_mm_mulhi_epu16(reinterpret_cast<__m128i>(a),
                                                reinterpret_cast<__m128i>(b)));
#else
    using wide = std::uint32_t __attribute__((vector_size(2 * width_of_vectors)));
    return __builtin_convertvector(
        (__builtin_convertvector(a, wide) * __builtin_convertvector(b, wide)) >> 16, wv);
#endif
}

// Between two colours, as far from the first as `share` says in 65536ths.
inline wv between(wv a, wv b, wv share) { return high(a, 65535 - share) + high(b, share); }

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
inline void put(float (&to)[3], d4 from) {
    const f4 found = __builtin_convertvector(from, f4);
    std::memcpy(to, &found, sizeof to);
}

inline double root(double x) { return std::sqrt(x); }  // IEEE 754 requires it to be exact

// The inverse as IEEE 754 has it, of 0 too, for which C++ has none.
template <typename T>
inline T inverse(T x) {
    return x != 0 ? 1 / x : std::copysign(std::numeric_limits<T>::infinity(), x);
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

// The following have the layout of NumPy's structured arrays in `layouts.py`.

struct Geom {
    std::int32_t mesh, texture;  // numbers of theirs; texture -1 for none
    std::int32_t number;         // in the image of numbers
    float rgba[4];
    float emission, specular, shininess;
    float repeat[2], offset;  // of the places in the texture
    float cube[3];            // times a point of the mesh: its direction in a cube of textures
    std::int32_t double_sided;  // whether its triangles are seen from behind too
    float cutoff;               // where its opacity is below it, nothing is drawn; 0 if all is
};

struct Pose {
    double position[3];  // in the world, metres
    Matrix turn;         // from its axes to the world's: of an eye, from the optical frame's
};

struct Box {  // pixels: to right - 1 and bottom - 1
    std::int32_t left, right, top, bottom;
};

constexpr int tile_side = 16;  // pixels of a light's map
inline int tiles_across(int size) { return (size + tile_side - 1) / tile_side; }

struct Light {
    std::int32_t kind;  // 0 directional, 1 point, 2 spot
    std::int32_t size;  // of its map: columns and rows; 0 if it throws no shadows
    float ambient[3], diffuse[3], specular[3], attenuation[3];
    float cutoff, exponent;  // cosine of the cone's half angle
    double position[3], direction[3];
    const float* map;  // depth of what is nearest to an eye at the light, by row and column
    std::uint32_t* changes;  // of each tile of the map, by row and column: how often it was drawn
    double step;       // a pixel's width and height at z = 1
    Pose eye;
};

struct View {
    std::int32_t width, height, first, last;  // rows to draw: first to last - 1
    std::int32_t sky, fogged;                 // number of the sky's texture, or -1
    std::int32_t poses, threads;              // how many poses of everything there are (`Moving`)
    float near, far;                          // nothing nearer is drawn; depth beyond is inf
    float fog[3], fog_start, fog_end, unused;
};

}  // namespace raster
