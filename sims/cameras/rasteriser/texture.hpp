// Textures with their mipmaps, and what is read from them.
#pragma once

#include <algorithm>

#include "types.hpp"

namespace raster {

// Where the colours of the pixels of a row come from: for each of two sizes of a texture the upper
// left and the lower left of four texels, numbered in all texels of the scene, and the weights of
// the right and of the lower ones; the weight of the second size; and the light. All weights are in
// 65536ths, twice in each lane, but the light.
struct Taps {
    enum { upper, lower = 2, right = 4, low = 6, share = 8, red_blue, green, clear, kinds };

    const std::uint32_t* const texels;  // of the scene

    Taps(int width, const std::uint32_t* all)
        : texels(all), stride_(width + widest), values_(std::size_t(stride_) * kinds) {}

    std::uint32_t* at(int kind, int x) { return values_.data() + kind * stride_ + x; }
    void set(int kind, int x, iv value) { store(at(kind, x), value); }
    iv get(int kind, int x) const { return load<iv>(values_.data() + kind * stride_ + x); }
    wv weights(int kind, int x) const { return reinterpret_cast<wv>(get(kind, x)); }

  private:
    int stride_;
    std::vector<std::uint32_t> values_;
};

inline iv twice(iv value) { return (value & 65535) | value << 16; }

// An image, which repeats, or a cube of six square ones.
class Texture {
  public:
    const bool is_cube, has_opacity;

    // How many texels one takes, with all of its sizes.
    static std::int64_t count(std::int64_t width, std::int64_t height, bool cube) {
        std::int64_t found = 0;
        const int sides = cube ? 6 : 1;
        for (height /= sides;; width = std::max<std::int64_t>(width / 2, 1),
                               height = std::max<std::int64_t>(height / 2, 1)) {
            found += sides * (width + 2) * (height + 2);
            if (width == 1 && height == 1) return found;
        }
    }

    // One whose texels, as `fill` writes them, begin at a place among those of the scene.
    Texture(std::int32_t start, int width, int height, int channels, bool cube)
        : is_cube(cube), has_opacity(channels == 4) {
        const int sides = cube ? 6 : 1;
        for (height /= sides;; width = std::max(width / 2, 1), height = std::max(height / 2, 1)) {
            levels_.push_back({width, height, start});
            start += sides * (width + 2) * (height + 2);
            if (width == 1 && height == 1) break;
        }
    }

    // Write all sizes of an image, `count` texels: red in their lowest bytes and opacity in their
    // highest.
    static void fill(std::uint32_t* to, int width, int height, int channels,
                     const std::uint8_t* data, bool cube) {
        std::vector<std::uint32_t> texels(std::size_t(width) * height);
        for (std::size_t k = 0; k < texels.size(); ++k) {
            const std::uint8_t* from = data + k * channels;
            const std::uint8_t red = from[0], green = channels > 2 ? from[1] : red;
            const std::uint8_t blue = channels > 2 ? from[2] : red;
            const std::uint32_t opacity = channels == 4 ? from[3] : 0;
            texels[k] = red | green << 8 | blue << 16 | opacity << 24;
        }
        const int sides = cube ? 6 : 1;
        for (height /= sides;;) {
            to = border(to, texels, width, height, cube);
            if (width == 1 && height == 1) break;
            const int across = std::max(width / 2, 1), down = std::max(height / 2, 1);
            texels = halved(texels, width, height * sides, across, down * sides);
            width = across, height = down;
        }
    }

    int levels() const { return static_cast<int>(levels_.size()); }
    int width() const { return levels_[0].width; }
    int height() const { return levels_[0].height; }

    // Pixels from x on lie at places (u, v), which repeat; `detail` is the mipmap's level in 256ths:
    // between two levels both are read.
    void place(Taps& taps, int x, fv u, fv v, int detail) const {
        place(taps, x, within(u - floored(u)), within(v - floored(v)), iv{}, detail);
    }

    // Pixels from x on lie in directions from the middle of a cube.
    void around(Taps& taps, int at, fv x, fv y, fv z, int detail) const {
        const fv ax = x < 0 ? -x : x, ay = y < 0 ? -y : y, az = z < 0 ? -z : z;
        const iv on_x = (ax >= ay) & (ax >= az), on_y = ~on_x & (ay >= az);
        const fv most = on_x ? ax : on_y ? ay : az;
        const fv s = on_x ? (x > 0 ? -z : z) : on_y ? x : z > 0 ? x : -x;
        const fv t = on_y ? (y > 0 ? z : -z) : -y;
        const iv first = on_x ? iv{} : on_y ? iv{} + 2 : iv{} + 4;
        const iv face = first + ((on_x ? x : on_y ? y : z) > 0 ? iv{} : iv{} + 1);
        const fv share = 0.5f / most;
        place(taps, at, within(s * share + 0.5f), within(t * share + 0.5f), face, detail);
    }

    static fv within(fv at) { return (at >= 0) & (at <= 1) ? at : fv{}; }  // also if it is none

    // What opacity, from 0 to 1, is compared with in each size, so that the share of texels that pass
    // is that of the finest size, where `least` is its first (I. Castano, "Computing Alpha Mipmaps",
    // 2010): means of leaves and gaps alone would vanish in the distance, or close. Sizes end where
    // no number gives that share; what is farther is read from the last of them.
    void keep_coverage(const std::uint32_t* all, std::vector<float>& least) const {
        double share = 0;  // that passes
        for (const Level& level : levels_) {
            if (std::min(level.width, level.height) < fewest && share > 0) return;
            std::int64_t passing[257]{}, count = std::int64_t(level.width) * level.height;
            for (int y = 1; y <= level.height; ++y)
                for (int x = 1; x <= level.width; ++x)
                    ++passing[all[level.start + std::size_t(y) * level.stride() + x] >> 24];
            for (int from = 255; from-- > 0;) passing[from] += passing[from + 1];
            int best = 0;
            if (&level == &levels_[0]) {
                while (best < 256 && !(static_cast<float>(best) / 255.0f >= least[0])) ++best;
                share = double(passing[best]) / double(count);
                continue;
            }
            const auto off = [&](int from) {
                return std::abs(double(passing[from]) / double(count) - share);
            };
            for (int from = 1; from <= 256; ++from)
                if (off(from) < off(best)) best = from;
            if (off(best) > 0.1 * std::min(share, 1 - share)) return;
            int last = best;  // with the same share: what is halfway between keeps outlines in place
            while (last < 256 && passing[last + 1] == passing[best]) ++last;
            least.push_back(0.5f * static_cast<float>(best - 1 + last) / 255.0f);
        }
    }

    // From 0 to 1, at a place from 0 to 1 in one of its sizes.
    float opacity(const std::uint32_t* all, float u, float v, int size) const {
        const Level& level = levels_[size];
        const float across = u * static_cast<float>(level.width) + 0.5f;
        const float down = v * static_cast<float>(level.height) + 0.5f;
        const int column = std::min(static_cast<int>(across), level.width);
        const int row = std::min(static_cast<int>(down), level.height);
        const std::uint32_t* at = all + level.start + std::size_t(row) * level.stride() + column;
        const auto between = [share = across - static_cast<float>(column)](const std::uint32_t* two) {
            const auto left = static_cast<float>(two[0] >> 24);
            return left + (static_cast<float>(two[1] >> 24) - left) * share;
        };
        const float above = between(at), below = between(at + level.stride());
        return (above + (below - above) * (down - static_cast<float>(row))) / 255.0f;
    }

  private:
    // Sizes for opacity end where a texel is a large share of it.
    static constexpr int fewest = 8;  // texels along a side

    // One of its sizes: six sides, if it is a cube, one below the other, and about each a border of
    // one texel, so that the four texels about a place are two pairs of neighbours.
    struct Level {
        int width, height;   // of a side
        std::int32_t start;  // among all texels
        int stride() const { return width + 2; }
    };

    void place(Taps& taps, int x, fv u, fv v, iv face, int detail) const {
        const int part = detail & 255, first = detail >> 8;
        place(taps, x, u, v, face, 0, levels_[first]);
        if (part) place(taps, x, u, v, face, 1, levels_[first + 1]);
        taps.set(Taps::share, x, iv{} + (part << 8 | part << 24));
    }

    struct Along {
        iv texel, share;  // of two neighbours the first, and the weight of the other
    };

    // Where places from 0 to 1 lie along a side of so many texels.
    static Along along(fv at, int count) {
        if (count < 32768) {
            const iv found = as_whole(at * (count * 65536.0f)) + 32768;  // in 65536ths
            return {found >> 16, twice(found)};
        }
        const fv found = at * static_cast<float>(count) + 0.5f, first = floored(found);
        const iv texel = as_whole(first), most = iv{} + count;
        return {texel < most ? texel : most, twice(as_whole((found - first) * 65536.0f))};
    }

    void place(Taps& taps, int x, fv u, fv v, iv face, int size, const Level& level) const {
        const Along column = along(u, level.width), row = along(v, level.height);
        iv at = row.texel * level.stride() + (column.texel + level.start);
        if (is_cube) at += face * (level.stride() * (level.height + 2));
        taps.set(Taps::upper + size, x, at);
        taps.set(Taps::lower + size, x, at + level.stride());
        if (size == 0)  // the larger one; they are read when the row is complete
            for (int k = 0; k < lanes; k += 4) {
                __builtin_prefetch(taps.texels + at[k]);
                __builtin_prefetch(taps.texels + at[k] + level.stride());
            }
        taps.set(Taps::right + size, x, column.share);
        taps.set(Taps::low + size, x, row.share);
    }

    // Write the sides of an image with their borders, and return where they end.
    static std::uint32_t* border(std::uint32_t* to, const std::vector<std::uint32_t>& texels,
                                 int width, int height, bool cube) {
        for (auto side = texels.begin(); side != texels.end(); side += std::size_t(width) * height)
            for (int y = -1; y <= height; ++y) {
                const int beyond = cube ? std::min(std::max(y, 0), height - 1)
                                        : (y + height) % height;
                const auto row = side + std::size_t(beyond) * width;
                *to++ = row[cube ? 0 : width - 1];
                to = std::copy(row, row + width, to);
                *to++ = row[cube ? width - 1 : 0];
            }
        return to;
    }

    // Smaller, rounded down: each texel the mean of what it covers.
    static std::vector<std::uint32_t> halved(const std::vector<std::uint32_t>& from, int width,
                                             int height, int across, int down) {
        std::vector<std::uint32_t> to;
        to.reserve(std::size_t(across) * down);
        if (width == 2 * across && height == 2 * down) {  // quicker, and the same
            for (int y = 0; y < down; ++y)
                for (int x = 0; x < across; ++x) {
                    const std::uint32_t* above = &from[std::size_t(2 * y) * width + 2 * x];
                    const std::uint32_t texels[4] = {above[0], above[1], above[width],
                                                     above[width + 1]};
                    std::uint32_t red_blue = 0x20002, green_opacity = 0x20002;
                    for (const std::uint32_t texel : texels)
                        red_blue += texel & 0xff00ff, green_opacity += texel >> 8 & 0xff00ff;
                    to.push_back((red_blue >> 2 & 0xff00ff) | (green_opacity << 6 & 0xff00ff00));
                }
            return to;
        }
        // Of an odd size, texels that two cover count for each by their share: all stays in place.
        for (int y = 0; y < down; ++y)
            for (int x = 0; x < across; ++x) {
                std::uint64_t sums[4] = {0, 0, 0, 0};
                using Wide = std::int64_t;
                const auto shares = [](Wide at, Wide size, Wide smaller, auto found) {
                    const Wide begin = at * size, end = begin + size;
                    for (Wide k = begin / smaller; k * smaller < end; ++k)
                        found(k, std::min((k + 1) * smaller, end) - std::max(k * smaller, begin));
                };
                shares(y, height, down, [&](Wide row, Wide rows) {
                    shares(x, width, across, [&](Wide column, Wide columns) {
                        const std::uint32_t texel = from[row * width + column];
                        for (int k = 0; k < 4; ++k)
                            sums[k] += std::uint64_t(rows * columns) * (texel >> 8 * k & 255);
                    });
                });
                const std::uint64_t count = std::uint64_t(width) * height;
                for (std::uint64_t& sum : sums) sum = (sum + count / 2) / count;
                to.push_back(static_cast<std::uint32_t>(sums[0] | sums[1] << 8 | sums[2] << 16 |
                                                        sums[3] << 24));
            }
        return to;
    }

    std::vector<Level> levels_;
};

// Colours of as many pixels as there are lanes, 0 to 65280 for 0 to 255.
struct Colours {
    wv red_blue, green;  // in each lane red below blue, and green below what counts for nothing
};

inline Colours between(Colours a, Colours b, wv share) {
    return {between(a.red_blue, b.red_blue, share), between(a.green, b.green, share)};
}

inline Colours coloured(iv texels) {
    const iv upper = iv{} + static_cast<std::int32_t>(0xff00ff00u);
    return {reinterpret_cast<wv>((texels << 8) & upper), reinterpret_cast<wv>(texels & upper)};
}

struct Pair {
    iv left, right;
};

// Texels at some places, and their neighbours to the right.
inline Pair pair(const std::uint32_t* texels, const std::uint32_t* at) {
    const auto two = [&](int k) { return load<std::uint64_t>(texels + at[k]); };
#ifdef __AVX2__
    const auto one = reinterpret_cast<iv>(qv{two(0), two(1), two(4), two(5)});
    const auto other = reinterpret_cast<iv>(qv{two(2), two(3), two(6), two(7)});
    return {RASTER_SHUFFLE(iv, one, other, 0, 2, 8, 10, 4, 6, 12, 14),
            RASTER_SHUFFLE(iv, one, other, 1, 3, 9, 11, 5, 7, 13, 15)};
#else
    const auto one = reinterpret_cast<iv>(qv{two(0), two(1)});
    const auto other = reinterpret_cast<iv>(qv{two(2), two(3)});
    return {RASTER_SHUFFLE(iv, one, other, 0, 2, 4, 6), RASTER_SHUFFLE(iv, one, other, 1, 3, 5, 7)};
#endif
}

inline Colours read(Taps& taps, int x, int size) {
    const Pair above = pair(taps.texels, taps.at(Taps::upper + size, x));
    const Pair below = pair(taps.texels, taps.at(Taps::lower + size, x));
    const wv low = taps.weights(Taps::low + size, x);
    return between(between(coloured(above.left), coloured(below.left), low),
                   between(coloured(above.right), coloured(below.right), low),
                   taps.weights(Taps::right + size, x));
}

}  // namespace raster
