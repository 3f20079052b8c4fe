// What every program here shares: its arguments, the clock, the payload and the file of samples.
#pragma once

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <fstream>
#include <numeric>
#include <stdexcept>
#include <string>
#include <vector>

namespace exchange {

using Pixels = std::vector<float>;

constexpr std::size_t kPixels = 1080 * 1080;
constexpr std::chrono::seconds kPatience{10};  // For one pong; nothing sound takes that long.

enum class Case { kSmall, kLarge, kLargeShared };

// CASE NODES SAMPLES WARM_UP OUT
struct Arguments {
    Case which = Case::kSmall;
    std::uint32_t nodes = 2;
    std::size_t samples = 0;
    std::size_t warm_up = 0;
    std::string out;

    std::size_t Total() const { return samples + warm_up; }
};

inline Arguments Parse(const std::vector<std::string>& words) {
    if (words.size() != 5) {
        throw std::invalid_argument("expected CASE NODES SAMPLES WARM_UP OUT");
    }
    Arguments parsed;
    if (words[0] == "large") {
        parsed.which = Case::kLarge;
    } else if (words[0] == "large-shared") {
        parsed.which = Case::kLargeShared;
    } else if (words[0] != "small") {
        throw std::invalid_argument("expected small, large or large-shared, found " + words[0]);
    }
    parsed.nodes = static_cast<std::uint32_t>(std::stoul(words[1]));
    parsed.samples = std::stoul(words[2]);
    parsed.warm_up = std::stoul(words[3]);
    parsed.out = words[4];
    if (parsed.nodes < 2) {
        throw std::invalid_argument("expected at least 2 nodes, found " + words[1]);
    }
    return parsed;
}

// Nanoseconds of the monotonic clock, the one that Python's perf_counter_ns reads, too.
inline std::int64_t Now() {
    return std::chrono::duration_cast<std::chrono::nanoseconds>(
               std::chrono::steady_clock::now().time_since_epoch())
        .count();
}

inline Pixels LargeArray() {
    Pixels pixels(kPixels);
    std::iota(pixels.begin(), pixels.end(), 0.0F);
    return pixels;
}

// Writes round trips as raw int64, without those of the warm-up.
inline void Write(const Arguments& arguments, const std::vector<std::int64_t>& taken) {
    std::ofstream file(arguments.out, std::ios::binary);
    file.write(reinterpret_cast<const char*>(taken.data() + arguments.warm_up),
               static_cast<std::streamsize>(arguments.samples * sizeof(std::int64_t)));
    if (!file.flush()) {
        throw std::runtime_error("cannot write " + arguments.out);
    }
}

// A benchmark in which somebody did not hear everything has measured something else.
inline void ExpectHeard(std::uint64_t found, std::uint64_t expected, const std::string& who) {
    if (found != expected) {
        throw std::runtime_error(who + ": expected to hear " + std::to_string(expected) +
                                 " pings, heard " + std::to_string(found));
    }
}

}  // namespace exchange
