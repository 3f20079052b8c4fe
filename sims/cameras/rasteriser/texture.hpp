// Textures with their mipmaps, and what is read from them.
#pragma once

#include <algorithm>

#include "types.hpp"

namespace raster {

using u16x8 = std::uint16_t __attribute__((vector_size(16)));
using u8x16 = std::uint8_t __attribute__((vector_size(16)));
using u32x4 = std::uint32_t __attribute__((vector_size(16)));
using f4 = float __attribute__((vector_size(16)));
using i4 = std::int32_t __attribute__((vector_size(16)));

// Lanes of two vectors, by their numbers.
#ifdef __clang__
#define RASTER_SHUFFLE(type, a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else  // GCC has the other one since version 12 only
#define RASTER_SHUFFLE(type, a, b, ...) __builtin_shuffle(a, b, type{__VA_ARGS__})
#endif

struct Level {
    int width, height;
    std::vector<std::uint32_t> texels;  // red in the lowest byte
};

// An image, or a cube of six square ones, one below the other.
class Texture {
  public:
    const bool is_cube;

    Texture(int width, int height, int channels, const std::uint8_t* data, bool cube)
        : is_cube(cube) {
        Level base{width, height, std::vector<std::uint32_t>(std::size_t(width) * height)};
        for (std::size_t k = 0; k < base.texels.size(); ++k) {
            const std::uint8_t* from = data + k * channels;
            const std::uint8_t red = from[0], green = channels > 2 ? from[1] : red;
            const std::uint8_t blue = channels > 2 ? from[2] : red;
            base.texels[k] = red | green << 8 | blue << 16 | 0xff000000u;
        }
        levels_.push_back(std::move(base));
        while (levels_.back().width > 1 || (!cube && levels_.back().height > 1))
            levels_.push_back(halved(levels_.back(), cube));
    }

    int levels() const { return static_cast<int>(levels_.size()); }
    const Level& level(int number) const { return levels_[number]; }

    // Colours (red, green, blue, 0 to 65280) at some places (u, v), which repeat; `detail` is the
    // mipmap's level in 256ths: between two levels both are read, and within each four texels.
    void sample(f8 u, f8 v, int count, int detail, f4* found) const {
        u -= floored(u), v -= floored(v);
        const Level& fine = levels_[detail >> 8];
        const Taps a = taps(fine, u, v);
        const int part = detail & 255;
        if (part == 0) {
            for (int k = 0; k < count; ++k) found[k] = widened(weighted(fine, a, fine, a, k), false);
            return;
        }
        const Level& coarse = levels_[(detail >> 8) + 1];
        const Taps b = taps(coarse, u, v);
        const float share = part * (1.0f / 256.0f);
        for (int k = 0; k < count; ++k) {
            const u16x8 both = weighted(fine, a, coarse, b, k);
            const f4 finer = widened(both, false), coarser = widened(both, true);
            found[k] = finer + (coarser - finer) * share;
        }
    }

    // Colour (0 to 65280) of a cube in a direction.
    f4 around(Vec3f ray, int detail) const {
        const float x = ray.x < 0 ? -ray.x : ray.x, y = ray.y < 0 ? -ray.y : ray.y;
        const float z = ray.z < 0 ? -ray.z : ray.z;
        int face;
        float s, t, most;
        if (x >= y && x >= z) {
            face = ray.x > 0 ? 0 : 1, most = x, s = ray.x > 0 ? -ray.z : ray.z, t = -ray.y;
        } else if (y >= z) {
            face = ray.y > 0 ? 2 : 3, most = y, s = ray.x, t = ray.y > 0 ? ray.z : -ray.z;
        } else {
            face = ray.z > 0 ? 4 : 5, most = z, s = ray.z > 0 ? ray.x : -ray.x, t = -ray.y;
        }
        const auto on = [&](int number) { return face_of(levels_[number], face, s / most, t / most); };
        const int first = detail >> 8;
        const f4 finer = on(first);
        if ((detail & 255) == 0) return finer;
        return finer + (on(first + 1) - finer) * ((detail & 255) * (1.0f / 256.0f));
    }

  private:
    struct Taps {  // of some places: texels, upper left, upper right, lower left, lower right
        std::int32_t at[4][lanes];
        std::int32_t right[lanes], low[lanes];  // weights of the right and the lower ones, of 256
    };

    static f8 floored(f8 value) {
        const f8 whole = __builtin_convertvector(__builtin_convertvector(value, i8), f8);
        return value < whole ? whole - 1.0f : whole;
    }

    // At places from 0 to 1.
    static Taps taps(const Level& level, f8 u, f8 v) {
        const f8 column = u * float(level.width) - 0.5f, row = v * float(level.height) - 0.5f;
        const f8 whole_column = floored(column), whole_row = floored(row);
        i8 left = __builtin_convertvector(whole_column, i8);
        i8 top = __builtin_convertvector(whole_row, i8);
        i8 right = left + 1, bottom = top + 1;
        left = left < 0 ? left + level.width : left;  // -1 to width - 1
        right = right >= level.width ? right - level.width : right;
        top = top < 0 ? top + level.height : top;
        bottom = bottom >= level.height ? bottom - level.height : bottom;
        top *= level.width, bottom *= level.width;
        Taps found;
        store(found.at[0], top + left), store(found.at[1], top + right);
        store(found.at[2], bottom + left), store(found.at[3], bottom + right);
        store(found.right, __builtin_convertvector((column - whole_column) * 256.0f, i8));
        store(found.low, __builtin_convertvector((row - whole_row) * 256.0f, i8));
        return found;
    }

    // Colour of a cube's face at a place from -1 to 1.
    static f4 face_of(const Level& level, int face, float s, float t) {
        const int side = level.width;
        const float column = (s + 1.0f) * (0.5f * side) - 0.5f, row = (t + 1.0f) * (0.5f * side) - 0.5f;
        const f8 places = floored(f8{column, row});
        const int left = static_cast<int>(places[0]), top = static_cast<int>(places[1]);
        const auto within = [side](int at) { return std::min(std::max(at, 0), side - 1); };
        const std::int32_t upper = (face * side + within(top)) * side;
        const std::int32_t lower = (face * side + within(top + 1)) * side;
        Taps a;
        a.at[0][0] = upper + within(left), a.at[1][0] = upper + within(left + 1);
        a.at[2][0] = lower + within(left), a.at[3][0] = lower + within(left + 1);
        a.right[0] = static_cast<int>((column - places[0]) * 256.0f);
        a.low[0] = static_cast<int>((row - places[1]) * 256.0f);
        return widened(weighted(level, a, level, a, 0), false);
    }

    // Bytes of two texels, widened.
    static u16x8 pair(std::uint32_t a, std::uint32_t b) {
        const u8x16 bytes = reinterpret_cast<u8x16>(u32x4{a, b, 0, 0});
        return reinterpret_cast<u16x8>(RASTER_SHUFFLE(
            u8x16, bytes, u8x16{}, 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23));
    }

    // Means of four texels each of two levels, times 256: the first one's in the lower lanes.
    static u16x8 weighted(const Level& fine, const Taps& a, const Level& coarse, const Taps& b,
                          int k) {
        const auto weights = [](std::int32_t one, std::int32_t other) {
            const auto both = reinterpret_cast<u16x8>(i4{one, other, 0, 0});  // little-endian
            return RASTER_SHUFFLE(u16x8, both, both, 0, 0, 0, 0, 2, 2, 2, 2);
        };
        const u16x8 right = weights(a.right[k], b.right[k]), low = weights(a.low[k], b.low[k]);
        const u16x8 left = 256 - right, high = 256 - low;
        const auto across = [&](int tap) __attribute__((always_inline)) {
            const std::uint32_t* one = fine.texels.data();
            const std::uint32_t* other = coarse.texels.data();
            return (pair(one[a.at[tap][k]], other[b.at[tap][k]]) * left +
                    pair(one[a.at[tap + 1][k]], other[b.at[tap + 1][k]]) * right + 128) >> 8;
        };
        return across(0) * high + across(2) * low;
    }

    static f4 widened(u16x8 values, bool upper) {
        const u16x8 whole =
            upper ? RASTER_SHUFFLE(u16x8, values, u16x8{}, 4, 8, 5, 8, 6, 8, 7, 8)
                  : RASTER_SHUFFLE(u16x8, values, u16x8{}, 0, 8, 1, 8, 2, 8, 3, 8);
        return __builtin_convertvector(reinterpret_cast<i4>(whole), f4);
    }

    // Half as wide and high, rounded down: each texel the mean of those that it covers.
    static Level halved(const Level& from, bool cube) {
        const int width = std::max(from.width / 2, 1);
        Level to{width, cube ? 6 * width : std::max(from.height / 2, 1), {}};
        to.texels.resize(std::size_t(to.width) * to.height);
        for (int y = 0; y < to.height; ++y)
            for (int x = 0; x < to.width; ++x)
                to.texels[std::size_t(y) * to.width + x] = mean(from, to, x, y);
        return to;
    }

    static std::uint32_t mean(const Level& from, const Level& to, int x, int y) {
        const int top = y * from.height / to.height, bottom = (y + 1) * from.height / to.height;
        const int left = x * from.width / to.width, right = (x + 1) * from.width / to.width;
        std::uint32_t sums[3] = {0, 0, 0}, count = 0;
        for (int row = top; row < bottom; ++row)
            for (int column = left; column < right; ++column, ++count)
                for (int k = 0; k < 3; ++k)
                    sums[k] += from.texels[std::size_t(row) * from.width + column] >> 8 * k & 255;
        for (std::uint32_t& sum : sums) sum = (sum + count / 2) / count;
        return sums[0] | sums[1] << 8 | sums[2] << 16 | 0xff000000u;
    }

    std::vector<Level> levels_;
};

}  // namespace raster
