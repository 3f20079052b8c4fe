// The messages of the exchange for roscpp, written by hand as roscpp's guide to adapting types has
// it. On the wire they are what gencpp would make of
//
//     bench_msgs/Ping: uint32 sender, uint32 receiver, int64 number, int64 stamp, float32[] payload
//     bench_msgs/Pong: uint32 sender, uint32 receiver, int64 number, int64 stamp
//
// In memory the payload is a shared pointer rather than a vector, so that within a process a fresh
// ping can carry the same array again.
#pragma once

#include <ros/message_traits.h>
#include <ros/serialization.h>

#include <cstdint>
#include <cstring>
#include <memory>
#include <vector>

#include "exchange.hpp"

namespace bench_msgs {

constexpr std::int64_t kHello = -1;      // Number of pings before the exchange.
constexpr std::uint32_t kEverybody = 0;  // Receiver of the last ping, whose number is the count.

struct Ping {
    std::uint32_t sender = 0;
    std::uint32_t receiver = 0;
    std::int64_t number = 0;
    std::int64_t stamp = 0;
    std::shared_ptr<const exchange::Pixels> payload;
};

struct Pong {
    std::uint32_t sender = 0;
    std::uint32_t receiver = 0;
    std::int64_t number = 0;
    std::int64_t stamp = 0;
};

}  // namespace bench_msgs

namespace ros {

namespace message_traits {

template <>
struct MD5Sum<bench_msgs::Ping> {
    static const char* value() { return "564532f3766edcfe18f29744e19511b6"; }
    static const char* value(const bench_msgs::Ping&) { return value(); }
};

template <>
struct MD5Sum<bench_msgs::Pong> {
    static const char* value() { return "6c39c244b0585caf72946bd403cef933"; }
    static const char* value(const bench_msgs::Pong&) { return value(); }
};

template <>
struct DataType<bench_msgs::Ping> {
    static const char* value() { return "bench_msgs/Ping"; }
    static const char* value(const bench_msgs::Ping&) { return value(); }
};

template <>
struct DataType<bench_msgs::Pong> {
    static const char* value() { return "bench_msgs/Pong"; }
    static const char* value(const bench_msgs::Pong&) { return value(); }
};

template <>
struct Definition<bench_msgs::Ping> {
    static const char* value() {
        return "uint32 sender\nuint32 receiver\nint64 number\nint64 stamp\nfloat32[] payload\n";
    }
    static const char* value(const bench_msgs::Ping&) { return value(); }
};

template <>
struct Definition<bench_msgs::Pong> {
    static const char* value() {
        return "uint32 sender\nuint32 receiver\nint64 number\nint64 stamp\n";
    }
    static const char* value(const bench_msgs::Pong&) { return value(); }
};

}  // namespace message_traits

namespace serialization {

template <>
struct Serializer<bench_msgs::Ping> {
    template <typename Stream>
    static void write(Stream& stream, const bench_msgs::Ping& ping) {
        stream.next(ping.sender);
        stream.next(ping.receiver);
        stream.next(ping.number);
        stream.next(ping.stamp);
        if (ping.payload) {
            stream.next(*ping.payload);
        } else {
            stream.next(std::uint32_t{0});
        }
    }

    template <typename Stream>
    static void read(Stream& stream, bench_msgs::Ping& ping) {
        stream.next(ping.sender);
        stream.next(ping.receiver);
        stream.next(ping.number);
        stream.next(ping.stamp);
        std::uint32_t length = 0;
        stream.next(length);
        if (length > 0) {  // As roscpp reads a vector: sized, then copied into.
            auto payload = std::make_shared<exchange::Pixels>(length);
            const std::uint32_t bytes = length * sizeof(float);
            std::memcpy(payload->data(), stream.advance(bytes), bytes);
            ping.payload = std::move(payload);
        }
    }

    static std::uint32_t serializedLength(const bench_msgs::Ping& ping) {
        const std::size_t length = ping.payload ? ping.payload->size() : 0;
        return static_cast<std::uint32_t>(2 * 4 + 2 * 8 + 4 + length * sizeof(float));
    }
};

template <>
struct Serializer<bench_msgs::Pong> {
    template <typename Stream, typename T>
    static void allInOne(Stream& stream, T pong) {
        stream.next(pong.sender);
        stream.next(pong.receiver);
        stream.next(pong.number);
        stream.next(pong.stamp);
    }

    ROS_DECLARE_ALLINONE_SERIALIZER
};

}  // namespace serialization

}  // namespace ros
