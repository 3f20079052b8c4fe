// Image sensor: from light to grey levels, and noise of images and depth, in one pass over samples.
//
// Random numbers are counter-based: those of a sample depend on a key and on the sample's place in
// the image alone, so that any part of an image may be computed by itself. All but depth is in
// whole numbers; depth is IEEE 754, as everywhere here. `development.py` has the same in NumPy.
#include <algorithm>
#include <cstdint>
#include <cstring>
#include <vector>

#if defined(__SSE4_1__)
#include <immintrin.h>
#endif

namespace {

constexpr int group = 64;         // samples of one call of `draw`
constexpr int chunk = 8 * group;  // samples that pass the stages together

// Numbers of 64 bits, and the products of their lower halves.
#if defined(__AVX2__)
using Lanes = std::uint64_t __attribute__((vector_size(32)));
inline Lanes product(Lanes a, Lanes b) { return (Lanes)_mm256_mul_epu32((__m256i)a, (__m256i)b); }
#else
using Lanes = std::uint64_t __attribute__((vector_size(16)));
#if defined(__SSE4_1__)
inline Lanes product(Lanes a, Lanes b) { return (Lanes)_mm_mul_epu32((__m128i)a, (__m128i)b); }
#else
inline Lanes product(Lanes a, Lanes b) { return (a & 0xFFFFFFFFu) * (b & 0xFFFFFFFFu); }
#endif
#endif

// Philox4x32-7 (J. K. Salmon et al., "Parallel Random Numbers: As Easy as 1, 2, 3", SC 2011), the
// fewest rounds with which it passes BigCrush. The last two words of the key are in the
// counter, after block and stream. Gives 64 numbers of 16 bits: the first words of
// eight blocks, then the second, third and fourth.
void draw(const std::uint32_t key[4], std::uint32_t stream, std::uint32_t number,
          std::uint16_t* out) {
    constexpr int lanes = sizeof(Lanes) / sizeof(std::uint64_t);
    for (int block = 0; block < 8; block += 2 * lanes) {
        Lanes words[2][4];  // of the even and of the odd blocks; the upper halves are of no account
        for (int odd = 0; odd < 2; ++odd) {
            Lanes a;
            for (int k = 0; k < lanes; ++k) a[k] = 8 * std::uint64_t(number) + block + 2 * k + odd;
            Lanes b = Lanes{} + stream, c = Lanes{} + key[2], d = Lanes{} + key[3];
            std::uint32_t first = key[0], second = key[1];
            for (int round = 0; round < 7; ++round) {
                const Lanes one = product(a, Lanes{} + 0xD2511F53u);
                const Lanes other = product(c, Lanes{} + 0xCD9E8D57u);
                a = (other >> 32) ^ b ^ (Lanes{} + first);
                b = other;
                c = (one >> 32) ^ d ^ (Lanes{} + second);
                d = one;
                first += 0x9E3779B9u, second += 0xBB67AE85u;
            }
            words[odd][0] = a, words[odd][1] = b, words[odd][2] = c, words[odd][3] = d;
        }
        for (int k = 0; k < 4; ++k) {
            const Lanes both = (words[0][k] & 0xFFFFFFFFu) | (words[1][k] << 32);
            std::memcpy(out + 16 * k + 2 * block, &both, sizeof both);
        }
    }
}

// Calls `stages(skipped, end, start)` for each chunk of samples first to last - 1: those from
// start + skipped to start + end - 1, of which sample `start` has the first random number.
template <typename Stages>
void pass(std::int64_t first, std::int64_t last, Stages stages) {
    for (std::int64_t start = first / chunk * chunk; start < last; start += chunk)
        stages(static_cast<int>(std::max(first - start, std::int64_t(0))),
               static_cast<int>(std::min(last - start, std::int64_t(chunk))), start);
}

template <typename T>
void look_up(const std::uint32_t* key, std::uint32_t stream, std::int64_t start, const T* table,
             T* found) {
    std::uint16_t places[chunk];
    for (int k = 0; k < chunk / group; ++k)
        draw(key, stream, static_cast<std::uint32_t>(start / group + k), places + k * group);
    for (int k = 0; k < chunk; ++k) found[k] = table[places[k]];
}

// Noise, whose places in a table are random, added to values that stay in 0 to `most`.
void add(const std::uint32_t* key, std::uint32_t stream, std::int64_t start,
         const std::int32_t* table, std::int32_t most, std::int32_t* values) {
    std::int32_t noise[chunk];
    look_up(key, stream, start, table, noise);
    for (int k = 0; k < chunk; ++k) {
        const std::int32_t sum = values[k] + noise[k];
        values[k] = sum < 0 ? 0 : sum > most ? most : sum;
    }
}

template <typename T>
void develop(const std::uint32_t* key, std::int64_t first, std::int64_t last, const T* image,
             const std::int32_t* table, const std::uint16_t* shares, const std::int32_t* shot,
             const std::int32_t* levels, const std::int32_t* steps, std::uint8_t* out) {
    pass(first, last, [=](int skipped, int end, std::int64_t start) {
        std::int32_t seen[chunk] = {};
        const T* from = image + start;
        for (int k = skipped; k < end; ++k) seen[k] = from[k];
        if (table)
            for (int k = skipped; k < end; ++k) seen[k] = table[seen[k]];
        if (shares) {
            const std::uint16_t* share = shares + start;
            for (int k = skipped; k < end; ++k) {
                const std::uint32_t product = std::uint32_t(seen[k]) * share[k];
                seen[k] = static_cast<std::int32_t>((product + 32767u) / 65535u);
            }
        }
        if (shot) add(key, 0, start, shot, 65535, seen);
        if (levels)
            for (int k = skipped; k < end; ++k) seen[k] = levels[seen[k]];
        if (steps) add(key, 1, start, steps, 255, seen);
        std::uint8_t* to = out + start;
        for (int k = skipped; k < end; ++k) to[k] = static_cast<std::uint8_t>(seen[k]);
    });
}

}  // namespace

extern "C" {
#pragma GCC visibility push(default)

// Rounded mean of images, through a table of 256 codes of light.
void develop_mean(std::int64_t samples, int images, const std::uint8_t* const* image,
                  const std::int32_t* codes, std::uint16_t* out) {
    // Division by 2 n as a multiplication: exact for up to 127 images.
    const std::uint64_t inverse = (std::uint64_t(1) << 32) / (2 * images) + 1;
    pass(0, samples, [=](int, int end, std::int64_t start) {
        std::uint32_t sums[chunk] = {};
        for (int each = 0; each < images; ++each)
            for (int k = 0; k < end; ++k) sums[k] += codes[image[each][start + k]];
        for (int k = 0; k < end; ++k)
            out[start + k] = static_cast<std::uint16_t>(((2 * sums[k] + images) * inverse) >> 32);
    });
}

// Samples first to last - 1 of an image, from grey levels (`wide` 0) or codes of light (`wide` 1).
// A stage whose table is null is left out: `table`, from these to roots of light (if there are
// `levels`) or to grey levels; `shares` of the roots by sample, of 65535; `shot`, noise of the
// roots; `levels` of the roots; and `steps`, noise of the levels.
void develop_image(const std::uint32_t* key, std::int64_t first, std::int64_t last, int wide,
                   const void* image, const std::int32_t* table, const std::uint16_t* shares,
                   const std::int32_t* shot, const std::int32_t* levels, const std::int32_t* steps,
                   std::uint8_t* out) {
    if (wide)
        develop(key, first, last, static_cast<const std::uint16_t*>(image), table, shares, shot,
                levels, steps, out);
    else
        develop(key, first, last, static_cast<const std::uint8_t*>(image), table, shares, shot,
                levels, steps, out);
}

// Samples first to last - 1 of values with noise: of a table's 65536 numbers, times the square of
// the value (`square`) or not; none below zero. `inf` stays.
void develop_depth(const std::uint32_t* key, std::int64_t first, std::int64_t last, int square,
                   const float* values, const float* table, float* out) {
    pass(first, last, [=](int skipped, int end, std::int64_t start) {
        float noise[chunk];
        look_up(key, 0, start, table, noise);
        const float* from = values + start;
        float* to = out + start;
        for (int k = skipped; k < end; ++k) {
            const float value = from[k];
            const float near = !square ? 1.0f : value < 1e9f ? value : 1e9f;
            const float sum = noise[k] * near * near + value;
            to[k] = sum > 0.0f ? sum : 0.0f;
        }
    });
}

// Square of the cosine of the angle between each pixel's ray (u, v, 1) and the normal of the
// surface in 3 x 3 pixels, from inverse depth and the factors that make Sobel's sums a slope.
void develop_slant(int width, int height, const float* inverse, const float* u, const float* v,
                   float per_u, float per_v, float* out) {
    std::vector<float> padded(3 * (width + 2));
    float* rows[3];
    for (int k = 0; k < 3; ++k) rows[k] = padded.data() + k * (width + 2) + 1;
    for (int y = 0; y < height; ++y) {
        for (int k = 0; k < 3; ++k) {
            const int row = std::clamp(y + k - 1, 0, height - 1);
            const float* from = inverse + std::int64_t(width) * row;
            std::copy(from, from + width, rows[k]);
            rows[k][-1] = from[0], rows[k][width] = from[width - 1];
        }
        const float *above = rows[0], *here = rows[1], *below = rows[2];
        float* found = out + std::int64_t(width) * y;
        for (int x = 0; x < width; ++x) {
            const float right = 2.0f * here[x + 1] + above[x + 1] + below[x + 1];
            const float left = 2.0f * here[x - 1] + above[x - 1] + below[x - 1];
            const float lower = 2.0f * below[x] + below[x - 1] + below[x + 1];
            const float upper = 2.0f * above[x] + above[x - 1] + above[x + 1];
            const float across = (right - left) * per_u, down = (lower - upper) * per_v;
            const float ahead = across * u[x] + down * v[y] - here[x];
            const float normal = ahead * ahead + across * across + down * down;
            found[x] = here[x] * here[x] / (normal * (1.0f + u[x] * u[x] + v[y] * v[y]));
        }
    }
}

#pragma GCC visibility pop
}  // extern "C"
