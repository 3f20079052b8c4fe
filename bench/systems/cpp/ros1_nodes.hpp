// Node 1 and its listeners for roscpp, whichever processes and threads they run in.
#pragma once

#include <ros/ros.h>

#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <functional>
#include <memory>
#include <mutex>
#include <stdexcept>
#include <string>
#include <vector>

#include "exchange.hpp"
#include "ros1_messages.hpp"

namespace ros1 {

using bench_msgs::Ping;
using bench_msgs::Pong;

constexpr std::uint32_t kUnbounded = 0;  // As the size of a queue: nothing is ever dropped.

// No log topic, and no handler that would make Ctrl-C wait.
inline void Init(const std::string& name) {
    ros::init(ros::M_string{}, name,
              ros::init_options::NoRosout | ros::init_options::NoSigintHandler);
}

// Nodes 2 to N: hear every ping, and reply to those for them.
class Listener {
  public:
    Listener(ros::NodeHandle handle, std::uint32_t number)
        : number_(number),
          pongs_(handle.advertise<Pong>("pong", kUnbounded)),
          pings_(handle.subscribe<Ping>("ping", kUnbounded, &Listener::OnPing, this,
                                        ros::TransportHints().tcpNoDelay())) {}

    std::uint64_t Heard() const { return heard_.load(std::memory_order_acquire); }
    bool Done() const { return done_; }

  private:
    void OnPing(const boost::shared_ptr<const Ping>& ping) {
        if (ping->receiver == bench_msgs::kEverybody) {
            exchange::ExpectHeard(heard_, static_cast<std::uint64_t>(ping->number),
                                  "node " + std::to_string(number_));
            done_ = true;
            return;
        }
        if (ping->receiver == number_) {
            auto pong = boost::make_shared<Pong>();
            pong->sender = number_;
            pong->receiver = ping->sender;
            pong->number = ping->number;
            pong->stamp = ping->stamp;
            pongs_.publish(pong);
        }
        if (ping->number != bench_msgs::kHello) {
            heard_.fetch_add(1, std::memory_order_release);
        }
    }

    std::uint32_t number_;
    std::atomic<std::uint64_t> heard_{0};
    bool done_ = false;
    ros::Publisher pongs_;
    ros::Subscriber pings_;
};

// Node 1. Its functions are called in one thread, which may be another than that of its callbacks.
class Pinger {
  public:
    // Lets callbacks happen for at most a tenth of a second; returns at once when one has.
    using Turn = std::function<void()>;

    Pinger(ros::NodeHandle handle, const exchange::Arguments& arguments)
        : arguments_(arguments),
          pings_(handle.advertise<Ping>("ping", kUnbounded)),
          pongs_(handle.subscribe<Pong>("pong", kUnbounded, &Pinger::OnPong, this,
                                        ros::TransportHints().tcpNoDelay())) {
        if (arguments.which != exchange::Case::kSmall) {
            array_ = std::make_shared<const exchange::Pixels>(exchange::LargeArray());
        }
    }

    // Waits until `connections` subscribers are connected and the receiver's pong finds its way.
    void Connect(std::uint32_t connections, const Turn& turn) {
        const auto deadline = std::chrono::steady_clock::now() + 2 * exchange::kPatience;
        while (pings_.getNumSubscribers() < connections || !greeted_) {
            if (std::chrono::steady_clock::now() > deadline) {
                throw std::runtime_error("expected " + std::to_string(connections) +
                                         " subscribers, found " +
                                         std::to_string(pings_.getNumSubscribers()));
            }
            if (pings_.getNumSubscribers() >= connections) {
                auto hello = boost::make_shared<Ping>();
                hello->receiver = arguments_.nodes;
                hello->number = bench_msgs::kHello;
                pings_.publish(hello);
            }
            turn();
        }
    }

    // Returns all round trips; calls `rest` after each, outside of the measured time.
    std::vector<std::int64_t> Exchange(const Turn& turn, const std::function<void()>& rest) {
        std::vector<std::int64_t> taken(arguments_.Total());
        for (std::size_t number = 0; number < taken.size(); ++number) {
            const std::int64_t begin = exchange::Now();
            Send(arguments_.nodes, static_cast<std::int64_t>(number), begin);
            while (ponged_.load(std::memory_order_acquire) != static_cast<std::int64_t>(number)) {
                turn();
                if (exchange::Now() - begin >
                    std::chrono::nanoseconds(exchange::kPatience).count()) {
                    throw std::runtime_error("no pong for ping " + std::to_string(number));
                }
            }
            taken[number] = arrived_ - begin;
            rest();
        }
        return taken;
    }

    // Tells listeners in other processes that this was all, and waits until they are gone.
    void Dismiss() {
        array_.reset();
        Send(bench_msgs::kEverybody, static_cast<std::int64_t>(arguments_.Total()), 0);
        const auto deadline = std::chrono::steady_clock::now() + exchange::kPatience;
        while (pings_.getNumSubscribers() > 0 && std::chrono::steady_clock::now() < deadline) {
            ros::WallDuration(0.005).sleep();
        }
    }

    // For a `Turn` where callbacks run in other threads.
    void WaitForPong() {
        std::unique_lock<std::mutex> lock(mutex_);
        arrival_.wait_for(lock, std::chrono::milliseconds(100), [this] { return fresh_; });
        fresh_ = false;
    }

  private:
    void Send(std::uint32_t receiver, std::int64_t number, std::int64_t stamp) {
        auto ping = boost::make_shared<Ping>();
        ping->sender = 1;
        ping->receiver = receiver;
        ping->number = number;
        ping->stamp = stamp;
        ping->payload = arguments_.which == exchange::Case::kLarge && array_
                            ? std::make_shared<const exchange::Pixels>(*array_)
                            : array_;
        pings_.publish(ping);
    }

    void OnPong(const boost::shared_ptr<const Pong>& pong) {
        arrived_ = exchange::Now();  // Anything below is after the measured time.
        if (pong->number == bench_msgs::kHello) {
            greeted_ = true;
        }
        ponged_.store(pong->number, std::memory_order_release);
        const std::lock_guard<std::mutex> lock(mutex_);
        fresh_ = true;
        arrival_.notify_one();
    }

    const exchange::Arguments arguments_;
    std::shared_ptr<const exchange::Pixels> array_;
    std::atomic<bool> greeted_{false};
    std::int64_t arrived_ = 0;  // Written before `ponged_`, read after.
    std::atomic<std::int64_t> ponged_{bench_msgs::kHello};
    std::mutex mutex_;
    std::condition_variable arrival_;
    bool fresh_ = false;
    ros::Publisher pings_;
    ros::Subscriber pongs_;
};

}  // namespace ros1
