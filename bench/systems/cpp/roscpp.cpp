// Round trips through roscpp.
//
//     roscpp all CASE NODES SAMPLES WARM_UP OUT       all nodes in this process
//     roscpp ping CASE NODES SAMPLES WARM_UP OUT      node 1; the others are processes of their own
//     roscpp listen NUMBER                            one of the others
//
// One thread runs a process's callbacks, as with ros::spin(). Within a process roscpp hands
// subscribers the message that was published; between processes it goes over TCP without delay.

#include <ros/callback_queue.h>
#include <ros/ros.h>

#include <cstdint>
#include <exception>
#include <iostream>
#include <memory>
#include <string>
#include <vector>

#include "exchange.hpp"
#include "ros1_nodes.hpp"

namespace {

void Turn() {
    ros::getGlobalCallbackQueue()->callAvailable(ros::WallDuration(0.1));
}

void All(const exchange::Arguments& arguments) {
    ros1::Init("all");
    ros1::Pinger pinger(ros::NodeHandle(), arguments);
    std::vector<std::unique_ptr<ros1::Listener>> listeners;
    for (std::uint32_t number = 2; number <= arguments.nodes; ++number) {
        listeners.push_back(std::make_unique<ros1::Listener>(ros::NodeHandle(), number));
    }
    pinger.Connect(1, Turn);  // Of all subscribers in a process, roscpp makes one connection.
    const auto taken = pinger.Exchange(Turn, [] {});
    for (const auto& listener : listeners) {
        exchange::ExpectHeard(listener->Heard(), arguments.Total(), "a listener");
    }
    exchange::Write(arguments, taken);
}

void OnlyPing(const exchange::Arguments& arguments) {
    ros1::Init("node_1");
    ros1::Pinger pinger(ros::NodeHandle(), arguments);
    pinger.Connect(arguments.nodes - 1, Turn);
    const auto taken = pinger.Exchange(Turn, [] {});
    exchange::Write(arguments, taken);
    pinger.Dismiss();
}

void Listen(const std::string& number) {
    ros1::Init("node_" + number);
    const ros1::Listener listener(ros::NodeHandle(),
                                  static_cast<std::uint32_t>(std::stoul(number)));
    while (!listener.Done()) {
        Turn();
    }
}

}  // namespace

int main(int count, char** words) {
    try {
        const std::string role = count > 1 ? words[1] : "";
        const std::vector<std::string> rest(words + std::min(count, 2), words + count);
        if (role == "all") {
            All(exchange::Parse(rest));
        } else if (role == "ping") {
            OnlyPing(exchange::Parse(rest));
        } else if (role == "listen" && rest.size() == 1) {
            Listen(rest[0]);
        } else {
            throw std::invalid_argument("expected all, ping or listen");
        }
    } catch (const std::exception& error) {
        std::cerr << error.what() << '\n';
        return 1;
    }
    return 0;
}
