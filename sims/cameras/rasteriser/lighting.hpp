// Light on the vertices of a mesh, by the equations of OpenGL 1.5, section 2.14.1.
#pragma once

#include <algorithm>

#include "types.hpp"

namespace raster {

// 2 to the power of x, relative error below 2e-7; 0 where that would be below 2 to the power of -126,
// and no more than that of 127.
inline float power_of_2(float x) {
    if (!(x >= -126.0f)) return 0;
    x = std::min(x, 127.0f);
    int whole = static_cast<int>(x);
    whole -= x < static_cast<float>(whole);
    const float y = (x - whole) * 0.693147180559945f;  // Taylor's series about 0, ln 2 at most
    const float share =
        1.0f + y * (1.0f + y * (0.5f + y * (1.0f / 6 + y * (1.0f / 24 + y * (1.0f / 120 +
        y * (1.0f / 720 + y * (1.0f / 5040)))))));
    const std::int32_t bits = (whole + 127) << 23;
    float scale;
    std::memcpy(&scale, &bits, sizeof scale);
    return share * scale;
}

// Logarithms to base 2 of x > 0; absolute error below 1e-4.
inline fv log_2(fv x) {
    const iv bits = reinterpret_cast<iv>(x);
    // A polynomial in y from 0 to 1, exact at both ends.
    const fv y = reinterpret_cast<fv>((bits & 0x7fffff) | 0x3f800000) - 1.0f;
    return as_float((bits >> 23) - 127) +
           y * (1.44252727f + y * (-0.71791348f + y * (0.456540411f + y * (-0.275968957f + y * (0.120100259f + y * -0.025285506f)))));
}

inline float log_2(float x) { return log_2(fv{} + x)[0]; }

inline Vec3 unit(Vec3 a) {
    const double length = root(dot(a, a));
    return length > 0 ? a * (1.0 / length) : a;
}

constexpr double brightest = 1e6;  // the most light of a light on a point: white is 1

// Light as a number with which all that follows can compute: 0 if it is none.
inline float bounded(double light) {
    return static_cast<float>(light >= -brightest ? std::min(light, brightest)
                              : light < 0         ? -brightest
                                                  : 0.0);
}

// Light of a point with a unit normal, both in the world, each part from 0 to 1; and after it, so far
// apart, what each light that throws shadows adds where it shines.
inline void lit(const Geom& geom, const std::vector<Light>& lights, Vec3 point, Vec3 normal,
                Vec3 eye, Vec3f* to, std::size_t apart) {
    float sums[3];
    const auto within = [](float part) { return std::min(std::max(part, 0.0f), 1.0f); };
    for (int k = 0; k < 3; ++k) sums[k] = bounded(geom.emission * geom.rgba[k]);
    Vec3f* added = to;
    for (const Light& light : lights) {
        Vec3 towards{-light.direction[0], -light.direction[1], -light.direction[2]};
        double strength = 1;
        if (light.kind != 0) {
            const Vec3 way = Vec3{light.position[0], light.position[1], light.position[2]} - point;
            const double distance = root(dot(way, way));
            const Vec3 ray = unit(way);
            strength = 1.0 / std::max(light.attenuation[0] + light.attenuation[1] * distance +
                                          light.attenuation[2] * distance * distance,
                                      1e-30);
            if (light.kind == 2) {
                const double along = dot(ray, towards);
                strength *= along < light.cutoff || along <= 0 ? 0.0
                            : light.exponent == 0.0f
                                ? 1.0
                                : power_of_2(light.exponent * log_2(static_cast<float>(along)));
            }
            towards = ray;
        }
        const double facing = std::max(dot(normal, towards), 0.0);
        double shine = 0;
        if (facing > 0 && geom.specular > 0) {
            const double half = dot(normal, unit(towards + unit(eye - point)));
            if (half > 0)
                shine = power_of_2(std::max(
                    geom.shininess * 128.0f * log_2(static_cast<float>(half)), -100.0f));
        }
        float parts[3];
        for (int k = 0; k < 3; ++k)
            parts[k] = bounded(
                strength * (geom.rgba[k] * (light.ambient[k] + light.diffuse[k] * facing) +
                            geom.specular * light.specular[k] * shine));
        if (light.size) *(added += apart) = {parts[0], parts[1], parts[2]};
        else for (int k = 0; k < 3; ++k) sums[k] += parts[k];
    }
    *to = {within(sums[0]), within(sums[1]), within(sums[2])};
}

}  // namespace raster
