// An RGB-D odometry in a program of its own: dense alignment of grey images with a key frame.
//
//     c++ -std=c++17 -O2 -I"$(python -m nodes.outside.native)" odometry.cpp -o odometry
//
// Inverse compositional Gauss-Newton on the grey levels, from coarse to fine (S. Baker and
// I. Matthews, "Lucas-Kanade 20 years on", 2004). One thread: equal images give equal poses.

#include <algorithm>
#include <cmath>
#include <cstdio>
#include "visnav_link.hpp"

using Vector6 = std::array<double, 6>;

// A rigid motion, 3 rows of 4.
struct Motion {
    std::array<double, 12> m{1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0};
    std::array<double, 3> operator()(double x, double y, double z) const {
        return {m[0] * x + m[1] * y + m[2] * z + m[3], m[4] * x + m[5] * y + m[6] * z + m[7],
                m[8] * x + m[9] * y + m[10] * z + m[11]};
    }
    Motion operator*(const Motion& b) const {
        Motion c;
        for (int i = 0; i < 12; ++i) {
            c.m[i] = i % 4 == 3 ? m[i] : 0.0;
            for (int k = 0; k < 3; ++k) c.m[i] += m[i - i % 4 + k] * b.m[4 * k + i % 4];
        }
        auto& [x0, x1, x2, x, y0, y1, y2, y, z0, z1, z2, z] = c.m;  // errors must not grow
        const double length = std::hypot(x0, x1, x2);
        x0 /= length, x1 /= length, x2 /= length;
        const double shear = x0 * y0 + x1 * y1 + x2 * y2;
        y0 -= shear * x0, y1 -= shear * x1, y2 -= shear * x2;
        const double height = std::hypot(y0, y1, y2);
        y0 /= height, y1 /= height, y2 /= height;
        z0 = x1 * y2 - x2 * y1, z1 = x2 * y0 - x0 * y2, z2 = x0 * y1 - x1 * y0;
        return c;
    }
    Motion inverse() const {
        Motion found;
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) {
                found.m[4 * i + j] = m[4 * j + i];
                found.m[4 * i + 3] -= m[4 * j + i] * m[4 * j + 3];
            }
        return found;
    }
    double distance() const { return std::hypot(m[3], m[7], m[11]); }
    double angle() const { return std::acos(std::clamp((m[0] + m[5] + m[10] - 1) / 2, -1.0, 1.0)); }
    static Motion of(const Vector6& v) {  // translation, and rotation by a unit quaternion
        const double half = std::hypot(v[3], v[4], v[5]) / 2;
        const double s = half > 1e-12 ? std::sin(half) / (2 * half) : 0.5;
        return {visnav::Pose::from_quaternion(v[0], v[1], v[2], s * v[3], s * v[4], s * v[5],
                                              std::cos(half)).matrix};
    }
};

// A grey image with depth (0: none) at one resolution.
struct Level {
    int width = 0, height = 0;
    double fx = 0, fy = 0, cx = 0, cy = 0;
    std::vector<float> grey, depth;
};

// A pixel of the key frame: its point, grey level, and the derivative of that by a small motion.
struct Pixel {
    double x, y, z, grey;
    Vector6 derivative;
};

// Halve an image: means of grey levels, and of depths where they are of one surface.
Level halved(const Level& from) {
    Level to{from.width / 2, from.height / 2, from.fx / 2, from.fy / 2,
             (from.cx - 0.5) / 2, (from.cy - 0.5) / 2, {}, {}};
    for (int v = 0; v < to.height; ++v)
        for (int u = 0; u < to.width; ++u) {
            const int at = 2 * v * from.width + 2 * u, below = at + from.width;
            const float *g = from.grey.data(), *d = from.depth.data();
            const auto [least, most] = std::minmax({d[at], d[at + 1], d[below], d[below + 1]});
            const bool one = least > 0 && most < 1.05f * least;
            to.grey.push_back((g[at] + g[at + 1] + g[below] + g[below + 1]) / 4);
            to.depth.push_back(one ? (d[at] + d[at + 1] + d[below] + d[below + 1]) / 4 : 0);
        }
    return to;
}

Level read(const visnav::Frame& frame, const visnav::Camera& camera) {
    const visnav::Image &colours = frame.image("rgb8"), &depths = frame.image("depth32f");
    Level found{colours.width, colours.height, camera.fx, camera.fy, camera.cx, camera.cy, {}, {}};
    for (int v = 0; v < found.height; ++v) {
        const auto* rgb = colours.row<std::uint8_t>(v);
        const auto* depth = depths.row<float>(v);
        for (int u = 0; u < found.width; ++u, rgb += 3) {
            found.grey.push_back(0.25f * float(rgb[0] + 2 * rgb[1] + rgb[2]));
            found.depth.push_back(std::isfinite(depth[u]) ? depth[u] : 0.0f);
        }
    }
    return found;
}

// Take the pixels that have depth and a gradient.
std::vector<Pixel> pixels(const Level& level) {
    std::vector<Pixel> found;
    for (int v = 1; v + 1 < level.height; ++v)
        for (int u = 1; u + 1 < level.width; ++u) {
            const int at = v * level.width + u;
            const double z = level.depth[at], du = level.grey[at + 1] - level.grey[at - 1];
            const double dv = level.grey[at + level.width] - level.grey[at - level.width];
            if (z <= 0 || du * du + dv * dv < 36) continue;
            const double gu = 0.5 * level.fx * du, x = (u - level.cx) / level.fx;
            const double gv = 0.5 * level.fy * dv, y = (v - level.cy) / level.fy;
            found.push_back({x * z, y * z, z, level.grey[at],
                             {gu / z, gv / z, -(gu * x + gv * y) / z,
                              -gu * x * y - gv * (1 + y * y), gu * (1 + x * x) + gv * x * y, gv * x - gu * y}});
        }
    return found;
}

// Solve a symmetric system (its upper half is given) by Cholesky's method; false if it has no one.
bool solve(std::array<Vector6, 6> a, Vector6& b) {
    for (int i = 0; i < 6; ++i) {
        for (int k = 0; k < i; ++k) a[i][i] -= a[k][i] * a[k][i];
        if (!(a[i][i] > 1e-6)) return false;
        a[i][i] = std::sqrt(a[i][i]);
        for (int j = i + 1; j < 6; ++j) {
            for (int k = 0; k < i; ++k) a[i][j] -= a[k][i] * a[k][j];
            a[i][j] /= a[i][i];
        }
        for (int k = 0; k < i; ++k) b[i] -= a[k][i] * b[k];
        b[i] /= a[i][i];
    }
    for (int i = 5; i >= 0; b[i] /= a[i][i], --i)
        for (int k = i + 1; k < 6; ++k) b[i] -= a[i][k] * b[k];
    return true;
}

// Improve the motion from the key frame to an image; return the share of pixels that fit.
double align(const std::vector<Pixel>& key, const Level& image, Motion& motion) {
    double share = 0;
    for (int iteration = 0; iteration < 10; ++iteration) {
        std::array<Vector6, 6> a{};
        Vector6 b{};
        int fit = 0;
        for (const Pixel& pixel : key) {
            const auto [x, y, z] = motion(pixel.x, pixel.y, pixel.z);
            const double u = image.fx * x / z + image.cx, v = image.fy * y / z + image.cy;
            if (!(z > 0.05 && u >= 0 && v >= 0 && u < image.width - 1 && v < image.height - 1))
                continue;
            const int at = int(v) * image.width + int(u);
            if (image.depth[at] > 0 && std::abs(image.depth[at] - z) > 0.1 * z) continue;
            const double du = u - std::floor(u), dv = v - std::floor(v);
            const float* grey = &image.grey[at];
            const float* below = grey + image.width;
            const double error = (1 - dv) * ((1 - du) * grey[0] + du * grey[1]) +
                                 dv * ((1 - du) * below[0] + du * below[1]) - pixel.grey;
            const double weight = 1 / (1 + error * error / 64);  // Cauchy's, 8 grey levels
            fit += std::abs(error) < 20;
            for (int i = 0; i < 6; ++i) {
                const double scaled = weight * pixel.derivative[i];
                b[i] += scaled * error;
                for (int j = i; j < 6; ++j) a[i][j] += scaled * pixel.derivative[j];
            }
        }
        if (!solve(a, b)) return 0;
        share = double(fit) / double(key.size());
        const Motion step = Motion::of(b);
        motion = motion * step.inverse();
        if (step.distance() < 1e-4 && step.angle() < 1e-4) break;
    }
    return share;
}

int main() try {
    visnav::Link link("dense odometry");
    const visnav::Camera camera = link.camera(0);
    if (camera.distortion != std::vector<double>(5)) throw visnav::Error("expected no distortion");
    link.ready();
    std::vector<std::vector<Pixel>> key;  // from coarse to fine
    Motion key_pose, motion, velocity;    // the motion is from the key frame to the image
    while (const auto frame = link.next()) {
        const Level half = halved(read(*frame, camera)), quarter = halved(half);
        const std::vector<Level> levels{halved(quarter), quarter, half};
        const Motion before = motion;
        motion = velocity * motion;
        double share = 0;
        for (std::size_t n = 0; n < key.size(); ++n) share = align(key[n], levels[n], motion);
        const bool lost = !key.empty() && share < 0.25;
        if (lost) motion = before;
        velocity = motion * before.inverse();
        const Motion pose = key_pose * motion.inverse();
        lost ? link.lost(*frame) : link.pose(*frame, {pose.m});
        if (share < 0.7 || motion.distance() > 0.3 || motion.angle() > 0.15) {
            key = {pixels(levels[0]), pixels(levels[1]), pixels(levels[2])};
            key_pose = pose;
            motion = {};
        }
    }
} catch (const std::exception& error) {
    std::fprintf(stderr, "%s\n", error.what());
    return 1;
}
